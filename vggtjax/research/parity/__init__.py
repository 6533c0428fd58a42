"""A model's weights checked: alone, and beside the public PyTorch code."""
