"""The Mitsuba side: the shape plugin, and its registration for every variant."""

from .registration import register, register_variant

__all__ = ["register", "register_variant"]
