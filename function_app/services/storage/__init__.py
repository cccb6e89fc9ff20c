"""Records, reminders, retention and batched writes."""
