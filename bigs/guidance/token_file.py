"""Learned words: embeddings that stand for one object, in the file that diffusers calls textual inversion."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from safetensors.torch import save
from torch import Tensor

from bigs.atomic import atomic_write
from bigs.checks import InputError, check_finite
from bigs.guidance.diffusers_folder import Parts
from bigs.weights import load_weights


class Token(NamedTuple):
    """A word that the tokenizer does not know, and what the text encoder is given for it."""

    name: str
    embedding: Tensor  # [n, width]; usually n = 1, otherwise the word counts as n words


def read_token(path: Path) -> Token:
    """The one token in a file.

    Raises:
        InputError: the file is missing or unreadable, or holds anything else than one embedding.
    """
    found = load_weights(path, "a learned token")
    if len(found) != 1:
        raise InputError(f"{path}: expected one learned token, found {len(found)} tensors")
    ((name, embedding),) = found.items()
    if embedding.ndim not in (1, 2) or not name.strip():
        raise InputError(f"{path}: {name}: expected shape [width], found {list(embedding.shape)}")
    check_finite(f"{path}: {name}", embedding)
    return Token(name, embedding.float().reshape(-1, embedding.shape[-1]))


def write_token(path: Path, token: Token) -> None:
    """Write the file that `StableDiffusionPipeline.load_textual_inversion` reads; whole or not at all."""
    content = save({token.name: token.embedding.detach().float().cpu().contiguous()}, {"format": "pt"})
    with atomic_write(path) as file:
        file.write(content)


def add_token(parts: Parts, token: Token) -> str:
    """Teach a token to a model's tokenizer and text encoder.

    Returns:
        What to write for it in a prompt: its name, and more words after it if it has several embeddings.

    Raises:
        InputError: the model knows the word already, or its embeddings have another width.
    """
    width = parts.text_encoder.config.hidden_size
    if token.embedding.shape[1] != width:
        raise InputError(
            f"token {token.name}: expected an embedding of width {width} as the text_encoder's, "
            f"found {token.embedding.shape[1]}"
        )
    words = [token.name, *(f"{token.name}_{index}" for index in range(1, len(token.embedding)))]
    rows = new_words(parts, words)
    embeddings = parts.text_encoder.get_input_embeddings().weight
    with torch.no_grad():
        embeddings[rows] = token.embedding.to(embeddings)
    return " ".join(words)


def new_words(parts: Parts, words: list[str]) -> list[int]:
    """Add words to the tokenizer and rows for them to the text encoder; returns which rows.

    Raises:
        InputError: the tokenizer knows one of them already, or cannot tell it from others.
    """
    known = parts.tokenizer.get_vocab()
    for word in words:
        if word in known:
            raise InputError(f"token {word}: expected a word that is new to the model, found one that it has")
    parts.tokenizer.add_tokens(words)
    rows = max(len(parts.tokenizer), parts.text_encoder.config.vocab_size)
    parts.text_encoder.resize_token_embeddings(rows, mean_resizing=False)
    parts.text_encoder.requires_grad_(False)
    found: list[int] = parts.tokenizer.convert_tokens_to_ids(words)
    for word, row in zip(words, found, strict=True):
        if parts.tokenizer(word, add_special_tokens=False).input_ids != [row]:
            raise InputError(
                f"token {word}: expected a word that the tokenizer keeps whole, found one that it splits"
            )
    return found
