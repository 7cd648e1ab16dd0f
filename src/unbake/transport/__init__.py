"""The paper, in reading order: vertex, operator, path_sample, prior, terms, methods, objective.

Nothing here knows files, settings or the training loop; all that is needed comes in as values.
"""
