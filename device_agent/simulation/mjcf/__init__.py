"""Information read from MuJoCo models, shared by drivers and geometry."""
