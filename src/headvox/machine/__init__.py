"""What the stages run on: compiled loops, vectors, threads, clocks, interrupts."""
