"""What a run leaves on the disk: its folder, its log and its checkpoints."""
