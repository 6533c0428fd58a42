"""The app in a browser: a video in; viewer, film and files out."""
