"""`unbake view`: a data set or a run on a page of this machine."""
