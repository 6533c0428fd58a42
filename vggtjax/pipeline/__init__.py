"""A clip and a model -> a result: the data flow, one clip, several methods."""
