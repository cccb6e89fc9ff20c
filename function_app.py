"""A Functions host looks for this file, then imports the package ``function_app`` beside it, where the app is."""
