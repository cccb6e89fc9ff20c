"""Cameras of real rooms: MJPEG over HTTP, RTSP, and cameras of this machine. ONVIF finds them in the network."""
