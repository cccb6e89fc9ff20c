"""Planning of joint trajectories, gaze, speech movements and navigation."""
