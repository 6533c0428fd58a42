"""What a reconstruction is, and everything that is written of it: arrays, point clouds, pictures, scenes."""
