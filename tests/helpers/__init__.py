"""What tests share: scenes with known truth, makers of files, clients of the live server."""
