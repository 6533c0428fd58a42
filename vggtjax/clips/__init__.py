"""Images, folders and video -> frames of the model's size, with the way back to the pixels they came from."""
