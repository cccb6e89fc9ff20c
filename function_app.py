"""A Functions host looks for this file by name, then imports the package ``function_app`` beside it, where the app is."""
