"""The paper, in reading order: vertex, operator, path_sample, prior, terms, methods, objective.

Nothing here reads files or settings or depends on the training loop: inputs are values.
"""
