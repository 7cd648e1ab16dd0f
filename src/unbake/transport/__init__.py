"""The paper, in reading order: vertex, operator, series, image, prior, objective.

Nothing here knows files, settings or the training loop; all that is needed comes in as values.
"""
