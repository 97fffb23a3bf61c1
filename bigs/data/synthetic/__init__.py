"""Synthetic clips: two hands hold and turn an object; images, masks, initial estimates and ground truth."""

from bigs.data.synthetic.clip import make_clip
from bigs.data.synthetic.objects import OBJECT_KINDS, ObjectKind

__all__ = ["OBJECT_KINDS", "ObjectKind", "make_clip"]
