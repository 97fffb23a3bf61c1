"""Commands that make a run and use it: demo, info, reconstruct, render, export, view, ablate; and doctor."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import tyro

from bigs.cli.preprocess import NO_VIDEO, VideoOptions, clip_of
from bigs.cli.terminal import (
    ClipPath,
    Preset,
    RunPath,
    fail_for,
    importing,
    print_table,
    print_tables,
    say,
    settings_of,
    stderr,
    telling,
    use_threads,
)

if TYPE_CHECKING:
    from bigs.commands.run.reconstruct import Outcome

# A flag without a "--no-" form.
Flag = tyro.conf.FlagCreatePairsOff[bool]

# "auto", or the names of `train.plan.config.PriorKind`; a test compares them.
Prior = Literal["auto", "off", "symmetry", "trained", "sd"]

# The names of `commands.export.formats.FORMATS`; a test compares them.
Format = Literal[
    "ply",
    "spz",
    "splat-glb",
    "glb",
    "obj",
    "mesh",
    "hand-meshes",
    "rerun",
    "poses",
    "mano",
    "arctic",
    "challenge",
]


# The names in `commands.render.views`; a test compares them.
World = Literal["camera", "object"]
About = Literal["object", "scene"]
DepthFormat = Literal["png", "npy"]


def doctor() -> None:
    """List what is installed, what is missing, and what that would enable."""
    from bigs.commands.doctor import examine

    for heading, findings in examine():
        say(f"{heading}:")
        for finding in findings:
            say(f"  {finding.state:8s}{finding.name:16s} {finding.detail}")


def demo(out: Path = Path("demo_run"), preset: Preset = "demo", threads: int = 0, seed: int = 0) -> None:
    """Make a little clip of two hands and a bottle, reconstruct it, and print scores before and after.

    Args:
        out: the run folder to make, with the clip in out/clip; must be new or empty.
        preset: how much work to do.
        threads: CPU threads; 0 uses all cores.
        seed: random seed of the clip and of the reconstruction.
    """
    with importing():
        use_threads(threads)
        from bigs.commands.progress import progress_listener
        from bigs.commands.run.demo import demo as run_demo

    config = settings_of(preset, None, (f"seed={seed}",))
    with progress_listener(stderr, config) as listen:
        outcome = run_demo(out, config, seed=seed, listen=listen)
    show(outcome)


def info(clip: ClipPath, hand_model: Path | None = None) -> None:
    """Check a clip and describe it.

    Args:
        clip: a clip of any layout: a HOLD / HANDS-challenge build folder, a sequence of ARCTIC's raw release
            (ROOT/images/s05/box_grab_01/1), a clip of HO-3D (ROOT/train/SM1), a COLMAP or nerfstudio folder
            with hands.npz.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
    """
    from bigs.commands.clips.inspect import describe_clip

    for name, text in describe_clip(clip, hand_model):
        say(f"{name:10s} {text}")


def reconstruct(
    clip: ClipPath,
    out: Path,
    preset: Preset | None = None,
    hand_model: Path | None = None,
    gt: Path | None = None,
    resume: bool = False,
    config: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    without: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    perceptual_weights: tuple[Path, ...] = (),
    prior: Prior = "auto",
    prior_weights: str = "",
    prior_object: str = "object",
    prior_controlnet: str = "",
    prior_token: str = "",
    prior_edge_weights: str = "",
    threads: int = 0,
    video: Annotated[VideoOptions, tyro.conf.arg(name="")] = NO_VIDEO,
) -> None:
    """Reconstruct the hands and the object of a clip into a run folder.

    Args:
        clip: a HOLD / HANDS-challenge build folder, or the folder that holds it; or a video or a folder of
            images, from which RUN/clip is made first.
        out: the run folder to make.
        preset: smoke (seconds), demo, fast (minutes), full (the default), or paper
            (the paper's equations and weights).
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        gt: ground truth to score against, which the reconstruction never sees: gt.npz, an ARCTIC raw sequence
            or an HO-3D clip.
        resume: continue an interrupted run in the same folder.
        config: a config.yaml of an earlier run, instead of a preset.
        set: change one setting, as path=value (raster.eps2d=0.2, stages.hands-fine.steps=50); repeatable.
        without: leave out one ingredient (share, smooth, contact, lighting, ...) or loss term; repeatable.
        perceptual_weights: VGG-16 as torchvision publishes it (.pth or .safetensors), for the term
            "perceptual" of the preset paper; with a second file of LPIPS's channel weights the term is LPIPS.
        prior: how to complete the object where no frame shows it: off, symmetry (if the evidence is strong),
            trained or sd (symmetry, or else a diffusion model), or auto: what the weights are for; without
            weights, what the preset says (off in smoke and paper, symmetry elsewhere).
        prior_weights: a file of bigs prior train, or Stable Diffusion 1.5 or 2.1: a folder or its hub name.
        prior_object: name of the object for Stable Diffusion, such as "mustard bottle".
        prior_controlnet: a soft-edge ControlNet for it, a folder or a hub name.
        prior_token: the object's learned word, a file of bigs prior fit.
        prior_edge_weights: PiDiNet (table5_pidinet.pth) for the ControlNet; a built-in filter without it.
        threads: CPU threads; 0 uses all cores.
        video: options of preprocessing, if the clip is a video or a folder of images.
    """
    with importing():
        use_threads(threads)
        from bigs.commands.prior.weights import with_prior
        from bigs.commands.progress import progress_listener
        from bigs.commands.run.reconstruct import reconstruct as run
        from bigs.train.switches import without_all

    settings, unused = without_all(settings_of(preset, config, set), without)
    if perceptual_weights:
        files = tuple(str(path.resolve()) for path in perceptual_weights)
        settings = dataclasses.replace(settings, perceptual_weights=files)
    clip = clip_of(clip, out, video, hand_model)
    given = {
        "weights": prior_weights,
        "controlnet": prior_controlnet,
        "token": prior_token,
        "edge_weights": prior_edge_weights,
    }
    settings = with_prior(settings, prior, prior_object, given)
    with progress_listener(stderr, settings) as listen:
        outcome = run(
            clip, out, settings, hand_model=hand_model, ground_truth=gt, resume=resume, listen=listen
        )
    for name in unused:
        say(f"--without {name}: this plan does not contain it")
    show(outcome)


def render(
    run: RunPath,
    cameras: Path | None = None,
    out: Path | None = None,
    orbit: Flag = False,
    from_input: Flag = False,
    frame: int | None = None,
    play: Flag = False,
    about: About | None = None,
    pictures: int | None = None,
    size: tuple[int, int] | None = None,
    world: World | None = None,
    video: Path | None = None,
    depth: DepthFormat | None = None,
    background: str = "transparent",
    threads: int = 0,
) -> None:
    """Render a finished run as pictures or video: an orbit, the clip's own camera, or the cameras of a file.

    Args:
        run: the run folder.
        cameras: a transforms.json of instant-ngp, nerfstudio or Blender, or a camera path that nerfstudio's
            viewer saved (OpenGL camera-to-world). A frame_index in it sets the frame that a camera shows;
            otherwise --frame or --play does.
        out: folder for 0000.png, 0001.png, ...: RGBA with straight colour, or RGB over a background.
        orbit: a turn around the image's vertical, at one frame or while the clip plays.
        from_input: the clip's own camera, in every frame or in --frame.
        frame: the frame to show; an orbit without it shows the clip's middle frame.
        play: show the next frame of the clip in each picture, in a loop.
        about: centre of the orbit; the object if there is one.
        pictures: number of pictures of the orbit; 120, or with --play the clip's number of frames.
        size: width and height for cameras without a size; the clip's by default. An orbit and the clip's
            own camera keep their vertical angle.
        world: frame of a file's cameras: the clip's camera frame (x right, y down, z forward; metres; the
            default), or the object's own frame, which moves with the object.
        video: an .mp4 file of the pictures, at the rate of a camera path or of the clip, or at 30 a second
            where time stands still; needs the extra video.
        depth: also write OUT/depth/0000.png in 16-bit millimetres, or 0000.npy in metres; 0 where nothing is.
        background: white, black, R,G,B (each 0 to 255) or transparent, which is black in a video.
        threads: CPU threads; 0 uses all cores.
    """
    with importing():
        use_threads(threads)
        from bigs.commands.render.views import Shot, Wanted, background_of, render_run

    shot = Shot(cameras, orbit, from_input, frame, play, about, pictures, size, world)
    wanted = Wanted(out, video, depth, background_of(background))
    # On a terminal only: one line per picture would be too many elsewhere.
    with stderr.status("starting") as status:
        files = render_run(run, shot, wanted, status.update)
    rendered = sum(path.parent == out for path in files)
    if out is not None:
        beside = "" if depth is None else f", their depth in {out / 'depth'}"
        say(f"{rendered} pictures in {out}{beside}")
    if video is not None:
        say(str(video))


def export(
    run: RunPath,
    format: tyro.conf.UseAppendAction[tuple[Format, ...]] = (),
    out: Path | None = None,
    frames: tuple[int, ...] = (),
    all_frames: bool = False,
    clip: Path | None = None,
) -> None:
    """Write a finished run in other programs' formats.

    Args:
        run: the run folder.
        format: repeatable. Gaussians: ply (each subject unposed, or posed at chosen frames), spz,
            splat-glb (glTF with KHR_gaussian_splatting). Meshes: glb (animated: hands with skeletons,
            object), obj (all subjects at chosen frames, coloured), mesh (object), hand-meshes. Poses: poses
            (npz), mano, arctic, challenge (.pt). All together over time: rerun.
        out: where to write; the run folder if not given.
        frames: frames to write, for ply, spz, splat-glb, obj and hand-meshes. By default ply is unposed,
            hand-meshes has every frame, and the others have the clip's middle one.
        all_frames: write every frame, for the same formats.
        clip: the clip with the input images, for rerun, if it has moved.
    """
    from bigs.checks import InputError
    from bigs.commands.export.formats import Choice, check_format, write_format
    from bigs.commands.folder.clip import clip_of_run
    from bigs.commands.folder.contents import load_run

    if not format:
        raise InputError(f"--format: expected one or more of {', '.join(get_args(Format))}, found none")
    if frames and all_frames:
        raise InputError("--all-frames: expected this or --frames, found both")
    if clip is not None and "rerun" not in format:
        raise InputError(f"--clip: expected the format rerun, which holds images, found {', '.join(format)}")
    playback = load_run(run)
    wanted = tuple(range(len(playback))) if all_frames else frames or None
    images = clip_of_run(run, len(playback), clip) if "rerun" in format else None
    choice = Choice(wanted, images)
    # All are checked before the first is written.
    for name in format:
        check_format(playback, name, choice)
    files = [
        path
        for name in dict.fromkeys(format)
        for path in write_format(run if out is None else out, playback, name, choice)
    ]
    for path in files if len(files) <= 10 else [files[0], "...", files[-1]]:
        say(str(path))


def view(
    run: RunPath,
    host: str = "127.0.0.1",
    port: int = 8080,
    clip: Path | None = None,
    gt: Path | None = None,
) -> None:
    """Show a finished run in the browser: play it, turn it, bend its fingers. Ctrl-C ends.

    Args:
        run: the run folder.
        host: address to listen at; the default can be reached from this machine only.
        port: port to listen at; the next free one if it is taken.
        clip: the clip with the input images, if it has moved.
        gt: ground truth to show beside the result, as for bigs eval.
    """
    from bigs.commands.render.live import view as serve

    with telling():
        viewer = serve(run, host, port, clip=clip, gt=gt)
    with viewer, contextlib.suppress(KeyboardInterrupt):
        say(f"{viewer.url} (Ctrl-C ends)")
        viewer.wait()


def ablate(
    clip: ClipPath,
    out: Path,
    preset: Preset | None = None,
    rows: tuple[str, ...] | None = None,
    hand_model: Path | None = None,
    gt: Path | None = None,
    config: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    threads: int = 0,
) -> None:
    """Score the method with and without its ingredients on a clip, beside the paper's Table 3.

    Args:
        clip: a HOLD / HANDS-challenge build folder, or the folder that holds it.
        out: folder for one run per row, ablation.md and ablation.json; finished rows are kept.
        preset: the full method; fast by default.
        rows: what to leave out, each a name of reconstruct --without or several joined by +; the paper's by
            default.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        gt: ground truth (gt.npz) to score against; the clip's own by default.
        config: a config.yaml of an earlier run, instead of a preset.
        set: change one setting, as path=value; repeatable.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.commands.run.ablate import ablate as run
    from bigs.commands.run.ablate import default_rows

    settings = settings_of(preset, config, set, default="fast")
    with telling() as tell:
        found = run(
            clip,
            out,
            settings,
            default_rows() if rows is None else rows,
            hand_model=hand_model,
            ground_truth=gt,
            listen=tell,
        )
    print_tables([found.table], out)
    fail_for(found.failed)


def show(outcome: Outcome) -> None:
    for name, text in outcome.report.facts.items():
        say(f"{name}: {text}")
    for line in outcome.report.skipped:
        say(f"skipped: {line}")
    for line in outcome.report.retreats:
        say(f"recovered: {line}")
    print_table(outcome.table)
    for line in outcome.meanings:
        say(line)
    say("all scores: report.html, metrics.json, bigs eval RUN --all")
    times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in outcome.report.seconds.items())
    say(f"{outcome.seconds:.1f} s in all: {times}")
    say(f"results in {outcome.run}: see preview.png and report.html")
