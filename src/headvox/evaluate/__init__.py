"""How good is a detector? True heads, found heads, who belongs to whom, and what follows from it.

:mod:`.truth` and :mod:`.found` read the two sides, :mod:`.match` pairs them, :mod:`.metrics` and :mod:`.tracking` make
figures of the pairs, :mod:`.scores` puts them together; :mod:`.scenarios` has the frames, :mod:`.loop` runs a detector
over them, and :mod:`.report` prints, keeps and compares the results.
"""
