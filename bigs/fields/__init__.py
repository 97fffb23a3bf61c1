"""Triplane features and the small decoders that turn them into Gaussian parameters (paper section 3.2)."""

from bigs.fields.decoders import AppearanceDecoder, GeometryDecoder, SkinningDecoder
from bigs.fields.triplane import Triplane, sample_triplane

__all__ = ["AppearanceDecoder", "GeometryDecoder", "SkinningDecoder", "Triplane", "sample_triplane"]
