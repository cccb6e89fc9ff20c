"""Speech synthesizers that run on this machine."""

from device_agent.speech.espeak import Espeak

__all__ = ["Espeak"]
