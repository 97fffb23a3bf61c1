"""Stable Diffusion and a ControlNet in miniature, with random weights, written as diffusers writes them."""

from __future__ import annotations

import json
import string
from pathlib import Path
from typing import Any

import torch

from bigs.guidance.diffusers_folder import Parts

# Rows and columns of its pictures: 16 latents of two pixels.
SIZE = 32


def write_model(folder: Path, *, prediction: str = "epsilon", seed: int = 0) -> Path:
    """A model folder of 32 x 32 pictures and 16 x 16 latents; half a megabyte."""
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel

    torch.manual_seed(seed)
    unet = UNet2DConditionModel(**_unet_sizes())
    vae = AutoencoderKL(
        block_out_channels=(8, 16),
        down_block_types=("DownEncoderBlock2D", "DownEncoderBlock2D"),
        up_block_types=("UpDecoderBlock2D", "UpDecoderBlock2D"),
        latent_channels=4,
        norm_num_groups=4,
        sample_size=SIZE,
    )
    schedule = DDIMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        clip_sample=False,
        set_alpha_to_one=False,
        steps_offset=1,
        prediction_type=prediction,
    )
    tokenizer = write_tokenizer(folder / "tokenizer")
    unet.save_pretrained(folder / "unet")
    vae.save_pretrained(folder / "vae")
    schedule.save_pretrained(folder / "scheduler")
    _text_encoder(tokenizer).save_pretrained(folder / "text_encoder")
    return folder


def write_tokenizer(folder: Path) -> Any:
    """Words are spelt letter by letter, which is all that a vocabulary without merges can do."""
    from transformers import CLIPTokenizer

    letters = string.ascii_letters + string.digits + string.punctuation
    words = [*letters, *(f"{letter}</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    folder.mkdir(parents=True)
    (folder / "vocab.json").write_text(json.dumps({word: index for index, word in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"))
    tokenizer.save_pretrained(folder)
    return tokenizer


def write_controlnet(folder: Path, *, seed: int = 1) -> Path:
    """A ControlNet for the tiny model whose closing layers, zero in a new one, are random."""
    from diffusers import ControlNetModel, UNet2DConditionModel

    torch.manual_seed(seed)
    network = ControlNetModel.from_unet(
        UNet2DConditionModel(**_unet_sizes()), conditioning_embedding_out_channels=(4, 8)
    )
    with torch.no_grad():
        for weights in network.parameters():
            if not weights.any():
                weights.normal_(std=0.1)
    network.save_pretrained(folder)
    return folder


def as_pipeline(parts: Parts) -> Any:
    """The library's own pipeline of a model's parts."""
    from diffusers import StableDiffusionPipeline

    components = {name: part for name, part in vars(parts).items() if name != "controlnet"}
    return StableDiffusionPipeline(
        **components, safety_checker=None, feature_extractor=None, requires_safety_checker=False
    )


def _unet_sizes() -> dict[str, Any]:
    return {
        "sample_size": 16,
        "block_out_channels": (8, 16),
        "layers_per_block": 1,
        "down_block_types": ("CrossAttnDownBlock2D", "DownBlock2D"),
        "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D"),
        "cross_attention_dim": 16,
        "attention_head_dim": 4,
        "norm_num_groups": 4,
    }


def _text_encoder(tokenizer: Any) -> Any:
    from transformers import CLIPTextConfig, CLIPTextModel

    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(tokenizer),
            hidden_size=16,
            intermediate_size=32,
            num_hidden_layers=2,
            num_attention_heads=2,
            bos_token_id=tokenizer.bos_token_id,
            eos_token_id=tokenizer.eos_token_id,
            pad_token_id=tokenizer.pad_token_id,
        )
    )
