"""headvox on ROS 2: nodes that turn depth images and point clouds into heads.

``messages``, ``transforms``, ``synchronise``, ``latest``, ``parameters`` and ``statistics`` do not import ROS;
``sensors`` subscribes, ``outputs`` makes messages, ``node`` is what the nodes share.
"""
