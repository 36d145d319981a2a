"""What a pose is: topology, files, pose sets, alignment and the built-in body."""
