"""Routes of robot types, previews, movements and the script editor."""
