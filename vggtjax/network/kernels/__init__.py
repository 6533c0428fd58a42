"""What the network computes in another way on a platform: attention, convolutions, pieces, devices, 8 bits."""
