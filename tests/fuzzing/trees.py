"""Changes within what a file says: lists, dictionaries, arrays and what they hold."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable
from typing import Any

import numpy as np

from .hostile import changed_array, text

Value = Callable[[random.Random], Any]


def change_tree(rng: random.Random, tree: Any, value: Value) -> Any:
    """A copy of a tree in which one to three places are not as they were; `value` makes what is put there."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        tree = _change(rng, tree, value)
    return tree


def _change(rng: random.Random, tree: Any, value: Value) -> Any:
    """Goes down from the top, and stops somewhere."""
    entries = (
        list(tree) if isinstance(tree, dict) else list(range(len(tree))) if isinstance(tree, list) else []
    )
    if not entries or rng.random() < 0.08:
        return _replaced(rng, tree, value)
    key = rng.choice(entries)
    if rng.random() < 0.25:
        return _rearranged(rng, tree, key, entries, value)
    tree[key] = _change(rng, tree[key], value)
    return tree


def _replaced(rng: random.Random, node: Any, value: Value) -> Any:
    if isinstance(node, np.ndarray) and rng.random() < 0.75:
        return changed_array(rng, node)
    if isinstance(node, (int, float)) and not isinstance(node, bool) and rng.random() < 0.3:
        return node * rng.choice((0, -1, 2, 10, 1000, 1e6, 1e-6))
    if isinstance(node, str) and rng.random() < 0.3:
        return rng.choice((node + text(rng), text(rng) + node, node[: len(node) // 2], node.upper()))
    if isinstance(node, (list, dict)) and rng.random() < 0.3:
        return [node]
    return value(rng)


def _rearranged(rng: random.Random, tree: Any, key: Any, entries: list[Any], value: Value) -> Any:
    other = rng.choice(entries)
    match rng.randrange(5):
        case 0:
            del tree[key]
        case 1:
            tree[key], tree[other] = tree[other], tree[key]
        case 2 if isinstance(tree, dict):
            tree[text(rng)] = value(rng)
        case 3 if isinstance(tree, dict):
            tree[text(rng)] = tree.pop(key)
        case 2 | 3:
            tree.insert(key, value(rng))
        case _ if isinstance(tree, dict):
            tree[key] = copy.deepcopy(tree[other])
        case _:
            tree[key:key] = copy.deepcopy(tree[key:]) * rng.choice((1, 3))
    return tree
