"""Voices: programs of this machine that turn text into sound."""

from device_agent.speech.espeak import Espeak

__all__ = ["Espeak"]
