"""What makes a release: the files, what is tried of them, and the rules of versions."""
