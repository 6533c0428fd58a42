"""Pictures and films of coloured points, without a browser: splats, paths of virtual cameras, film files."""
