"""The loop at rate as a program in C, seen from here: what it is given, what it leaves, and the words for that."""
