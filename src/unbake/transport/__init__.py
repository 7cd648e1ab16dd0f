"""The paper, in reading order: vertex, operator, path_sample, prior, objective, path_tracer.

Nothing here knows files, settings or the training loop; all that is needed comes in as values.
"""
