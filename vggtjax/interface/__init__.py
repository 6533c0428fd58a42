"""What people see: the command line, and the app in a browser."""
