"""Routes of actions and Stop."""
