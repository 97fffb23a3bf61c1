"""Commands for the diffusion prior: prior fit, prior train."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from bigs.cli.terminal import ClipPath, say, stderr, use_threads

# The names in `guidance.diffusers_folder`, whose import takes seconds; a test compares them.
Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "float16", "bfloat16"]


def prior_fit(
    clip: ClipPath,
    object: str,
    model: str,
    out: Path,
    controlnet: str | None = None,
    edge_weights: Path | None = None,
    token: str = "<bigs-object>",
    steps: int = 1000,
    batch: int = 2,
    lr: float = 5e-3,
    conditioning_scale: float = 0.8,
    seed: int = 0,
    device: Device = "auto",
    precision: Precision = "auto",
    attention_slicing: bool = False,
    resume: bool = False,
    threads: int = 0,
) -> None:
    """Teach Stable Diffusion a word for the object of a clip (textual inversion), to use with its prior.

    Args:
        clip: a clip with object masks, in any layout that bigs info reads.
        object: name of the object in a word or two, such as "mustard bottle".
        model: a Stable Diffusion 1.5 or 2.1 folder as diffusers saves it, or its hub name.
        out: the .safetensors file to write, in the usual format of textual inversions.
        controlnet: a soft-edge ControlNet for that model, a folder or a hub name.
        edge_weights: PiDiNet (table5_pidinet.pth) for the ControlNet's edges; a built-in filter without it.
        token: the new word.
        steps: training steps.
        batch: pictures per step; memory grows with it.
        lr: learning rate.
        conditioning_scale: weight of the ControlNet.
        seed: random seed.
        device: auto takes a GPU if there is one.
        precision: auto is float16 on a GPU and float32 on a CPU.
        attention_slicing: less memory, more time.
        resume: continue an interrupted call.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.commands.prior.fit import InversionConfig, fit_token
    from bigs.commands.progress import steps_listener

    config = InversionConfig(object, token, steps, batch, lr, conditioning_scale, seed)
    with steps_listener(stderr, f"learning {token}") as listen:
        found = fit_token(
            clip,
            out,
            config,
            model=model,
            controlnet=controlnet,
            edge_weights=edge_weights,
            device=device,
            precision=precision,
            attention_slicing=attention_slicing,
            resume=resume,
            listen=listen,
        )
    say(f"{found.steps} steps on {found.frames} frames, mean loss at the end {found.loss:.4f}")
    say(f"memory: {found.peak_gib:.1f} GiB at most, {found.weights_gib:.1f} GiB of it weights")
    say(f"the word {token} is in {found.path}")


def prior_train(
    meshes: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MESHES")],
    out: Path,
    steps: int = 20_000,
    batch: int = 32,
    lr: float = 4e-4,
    views: int = 32,
    width: int = 96,
    up: Literal["x", "y", "z"] = "z",
    seed: int = 0,
    device: Device = "auto",
    resume: bool = False,
    threads: int = 0,
) -> None:
    """Train a small prior on renderings of a folder of meshes, for reconstruct --prior-weights.

    Args:
        meshes: folder of .ply, .obj, .glb, .stl or .off files, of any size.
        out: the .safetensors file to write, 10 MB.
        steps: training steps.
        batch: pictures per step.
        lr: learning rate.
        views: pictures per mesh.
        width: channels of the network; 96 makes 2.6 million parameters.
        up: the meshes' axis that points up.
        seed: random seed.
        device: auto takes a GPU if there is one.
        resume: continue an interrupted call.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.commands.prior.train import PixelConfig, PixelTrainingConfig, train_prior
    from bigs.commands.progress import steps_listener

    config = PixelTrainingConfig(steps, batch, lr, seed, net=PixelConfig(width))
    with steps_listener(stderr, "learning from meshes") as listen:
        found = train_prior(
            meshes, out, config, views=views, up=up, device=device, resume=resume, listen=listen
        )
    say(f"{found.steps} steps on {found.pictures} pictures of {found.meshes} meshes, loss {found.loss:.4f}")
    say(f"a prior of {found.parameters / 1e6:.2f} million parameters is in {found.path}")
