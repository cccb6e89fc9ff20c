"""Emulated cameras on loopback: MJPEG over HTTP, RTSP, and ONVIF."""
