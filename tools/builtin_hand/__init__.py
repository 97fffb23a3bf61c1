"""How `bigs/hand/builtin_hand.npz` is made; see `__main__.py`."""
