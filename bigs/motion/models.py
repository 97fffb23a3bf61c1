"""Incremental structure from motion on one object's features, and robust bundle adjustment of each model."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from bigs.colmap import pycolmap
from bigs.motion.features import FrameFeatures, quiet_colmap
from bigs.threads import thread_count


@dataclass(frozen=True)
class MappingConfig:
    """Matching and incremental mapping; lengths in pixels are of the clip's images."""

    # Each frame is matched with this many later ones, or with all. Far pairs may confuse sides that look
    # alike.
    pairs: Literal["sequential", "exhaustive"] = "sequential"
    overlap: int = 10
    # Tolerances: of a match from its epipolar line, and of a point's projection while a frame is added.
    match_error: float = 1.5
    pose_error: float = 3.0
    point_error: float = 1.5
    # Smallest angle between the first pair's rays, degrees.
    init_angle: float = 16.0
    min_model_size: int = 5
    # Robust bundle adjustment: rounds, scale of the Cauchy loss, and what is dropped between rounds.
    rounds: int = 3
    loss_scale: float = 0.5
    keep_error: float = 1.5
    keep_angle: float = 1.5
    # Fewest matches of a pair, of a first pair, and of an added frame, and their share of all.
    pair_inliers: int = 15
    init_inliers: int = 100
    pose_inliers: int = 30
    pose_share: float = 0.25
    seed: int = 0

    def loosened(self) -> MappingConfig:
        """For objects with little texture. Models found so need to be checked: many are wrong."""
        return replace(
            self, init_angle=6.0, pair_inliers=10, init_inliers=30, pose_inliers=12, pose_share=0.15
        )


class PartialModel(NamedTuple):
    """One model: some frames' poses, points, and what was seen where. Units are the model's own."""

    frames: np.ndarray  # [F] frame numbers, ascending
    rotations: np.ndarray  # [F, 3, 3] object to camera
    transl: np.ndarray  # [F, 3]
    points: np.ndarray  # [N, 3] object frame
    seen_frame: np.ndarray  # [M] frame number of each observation
    seen_feature: np.ndarray  # [M] which of that frame's features it is
    seen_point: np.ndarray  # [M] which point it shows


class Mapping(NamedTuple):
    """The models of structure from motion, and the features and matches behind them."""

    models: list[PartialModel]  # largest first
    matches: dict[tuple[int, int], np.ndarray]  # (earlier, later frame): [n, 2] verified pairs of features
    focal: float  # pixels, as estimated or given


def map_features(
    features: Sequence[FrameFeatures],
    K: np.ndarray,
    size: tuple[int, int],
    known_focal: bool,
    config: MappingConfig,
    candidates: dict[tuple[int, int], np.ndarray] | None = None,
) -> Mapping:
    """Match neighbouring frames and build models from them.

    Args:
        features: of T frames.
        K: [3, 3] intrinsics.
        size: width and height of the images.
        known_focal: whether the focal length in `K` is to be believed or is only a first guess.
        config: see there.
        candidates: matches of pairs of frames that were found already and are only to be verified; without
            them, descriptors are SIFT's and are matched here.
    """
    with tempfile.TemporaryDirectory(prefix="bigs-sfm-") as folder, quiet_colmap():
        file = Path(folder) / "clip.db"
        _write_database(file, features, K, size, known_focal, candidates is None)
        _match(file, config, candidates)
        matches = _verified_matches(file)
        (Path(folder) / "models").mkdir()
        found = pycolmap.incremental_mapping(
            file, folder, Path(folder) / "models", options=_pipeline_options(known_focal, config)
        )
        models, focals = [], []
        for reconstruction in found.values():
            _refine(reconstruction, known_focal, config)
            model = _read_model(reconstruction)
            if len(model.frames) >= config.min_model_size and len(model.points):
                models.append(model)
                focals.append(reconstruction.cameras[1].mean_focal_length())
    order = sorted(range(len(models)), key=lambda i: -len(models[i].seen_point))
    focal = focals[order[0]] if order else float(K[0, 0])
    return Mapping([models[i] for i in order], matches, focal)


def match_features(
    features: Sequence[FrameFeatures],
    K: np.ndarray,
    size: tuple[int, int],
    pairs: Sequence[tuple[int, int]],
    config: MappingConfig,
) -> dict[tuple[int, int], np.ndarray]:
    """Verified matches [n, 2] of `pairs` of frames, the earlier first; arguments as for `map_features`."""
    with tempfile.TemporaryDirectory(prefix="bigs-sfm-") as folder, quiet_colmap():
        file = Path(folder) / "clip.db"
        _write_database(file, features, K, size, True, True)
        names = Path(folder) / "pairs.txt"
        names.write_text("".join(f"{a:06d}.png {b:06d}.png\n" for a, b in pairs))
        pycolmap.match_image_pairs(
            file,
            matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=thread_count()),
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=names),
            verification_options=_verification(config),
            device=pycolmap.Device.cpu,
        )
        return _verified_matches(file)


def _verification(config: MappingConfig) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = config.pair_inliers
    options.ransac.max_error = config.match_error
    options.ransac.random_seed = config.seed
    return options


def _write_database(
    file: Path,
    features: Sequence[FrameFeatures],
    K: np.ndarray,
    size: tuple[int, int],
    known_focal: bool,
    describe: bool,
) -> None:
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=size[0],
        height=size[1],
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        camera_id=1,
    )
    camera.has_prior_focal_length = known_focal
    with pycolmap.Database.open(file) as database:
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for t, frame in enumerate(features):
            image = pycolmap.Image(name=f"{t:06d}.png", camera_id=1, image_id=t + 1)
            database.write_image(image, use_image_id=True)
            entry = pycolmap.Frame(frame_id=t + 1, rig_id=1)
            entry.add_data_id(image.data_id)
            database.write_frame(entry, use_frame_id=True)
            if len(frame.pixels):
                database.write_keypoints(t + 1, frame.pixels.astype(np.float32))
            if describe and len(frame.pixels):
                database.write_descriptors(
                    t + 1,
                    pycolmap.FeatureDescriptors(
                        data=frame.descriptors, type=pycolmap.FeatureExtractorType.SIFT
                    ),
                )


def frame_pairs(frames: int, config: MappingConfig) -> list[tuple[int, int]]:
    """The pairs of frames that are matched."""
    reach = config.overlap if config.pairs == "sequential" else frames
    return [(a, b) for a in range(frames) for b in range(a + 1, min(a + 1 + reach, frames))]


def _match(file: Path, config: MappingConfig, candidates: dict[tuple[int, int], np.ndarray] | None) -> None:
    verification = _verification(config)
    if candidates is not None:
        _verify(file, candidates, verification)
        return
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=thread_count())
    device = pycolmap.Device.cpu
    if config.pairs == "exhaustive":
        pycolmap.match_exhaustive(
            file, matching_options=matching, verification_options=verification, device=device
        )
        return
    pairing = pycolmap.SequentialPairingOptions(
        overlap=config.overlap, quadratic_overlap=False, loop_detection=False
    )
    pycolmap.match_sequential(
        file,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=device,
    )


def _verify(
    file: Path,
    candidates: dict[tuple[int, int], np.ndarray],
    verification: pycolmap.TwoViewGeometryOptions,
) -> None:
    names = []
    with pycolmap.Database.open(file) as database:
        for (a, b), matches in candidates.items():
            if len(matches):
                database.write_matches(a + 1, b + 1, matches.astype(np.uint32))
                names.append(f"{a:06d}.png {b:06d}.png\n")
    pairs = file.with_name("pairs.txt")
    pairs.write_text("".join(names))
    pycolmap.verify_matches(file, pairs, verification)


def _verified_matches(file: Path) -> dict[tuple[int, int], np.ndarray]:
    with pycolmap.Database.open(file) as database:
        pairs, geometries = database.read_two_view_geometries()
    matches = {}
    for pair, geometry in zip(pairs, geometries, strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair)
        if len(geometry.inlier_matches):
            matches[first - 1, second - 1] = np.asarray(geometry.inlier_matches, dtype=int)
    return matches


def _pipeline_options(known_focal: bool, config: MappingConfig) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=config.min_model_size,
        extract_colors=False,
        num_threads=thread_count(),
        random_seed=config.seed,
        ba_refine_focal_length=not known_focal,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
    )
    mapper = options.mapper
    mapper.init_min_tri_angle = config.init_angle
    mapper.init_min_num_inliers = config.init_inliers
    mapper.abs_pose_min_num_inliers = config.pose_inliers
    mapper.abs_pose_min_inlier_ratio = config.pose_share
    mapper.init_max_error = config.match_error
    mapper.abs_pose_max_error = config.pose_error
    mapper.abs_pose_refine_focal_length = not known_focal
    mapper.filter_max_reproj_error = config.point_error
    options.triangulation.merge_max_reproj_error = config.point_error
    options.triangulation.complete_max_reproj_error = config.point_error
    return options


def _refine(reconstruction: pycolmap.Reconstruction, known_focal: bool, config: MappingConfig) -> None:
    """Robust bundle adjustment; what fits badly or hangs on a thin angle is dropped between the rounds."""
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=not known_focal,
        refine_principal_point=False,
        refine_extra_params=False,
        print_summary=False,
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = config.loss_scale
    for _ in range(config.rounds):
        manager = pycolmap.ObservationManager(reconstruction)
        manager.filter_points3D_with_short_tracks(3)
        if reconstruction.num_points3D() < _FEWEST_POINTS:
            return
        problem = pycolmap.BundleAdjustmentConfig()
        for image_id in reconstruction.reg_image_ids():
            problem.add_image(image_id)
        problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, problem, reconstruction).solve()
        pycolmap.ObservationManager(reconstruction).filter_all_points3D(config.keep_error, config.keep_angle)


# With fewer points there is nothing to adjust.
_FEWEST_POINTS = 30


def _read_model(reconstruction: pycolmap.Reconstruction) -> PartialModel:
    images = sorted(
        (image for image in reconstruction.images.values() if image.has_pose),
        key=lambda image: image.image_id,
    )
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    index = {point: i for i, point in enumerate(sorted(reconstruction.points3D))}
    seen = [
        (image.image_id - 1, feature, index[point2D.point3D_id])
        for image in images
        for feature, point2D in enumerate(image.points2D)
        if point2D.has_point3D()
    ]
    table = np.array(seen, dtype=int).reshape(-1, 3)
    return PartialModel(
        np.array([image.image_id - 1 for image in images], dtype=int),
        poses[:, :, :3],
        poses[:, :, 3],
        np.array([reconstruction.points3D[point].xyz for point in sorted(index)]).reshape(-1, 3),
        *table.T,
    )
