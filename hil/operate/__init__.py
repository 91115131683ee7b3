"""A stage in operation: a loop that runs until it is ended, the verbs it obeys, the memory in which both cross."""
