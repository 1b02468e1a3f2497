"""ConCent-Warp: contact-centric real-to-sim-to-real learning from one demonstration."""

__version__ = "0.1.0"
