"""Long clips in windows of frames: which frames, how windows are joined, and one result of all of them."""
