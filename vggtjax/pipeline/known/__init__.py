"""What is known of a clip: cameras, scale and pixels without depth, brought into a finished result."""
