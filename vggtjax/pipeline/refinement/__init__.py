"""Bundle adjustment of a result's cameras over matches between the source's pictures. Does not import jax."""
