"""The compiled engine. Use `bigs.raster`, which checks shapes and knows torch."""

from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bigs.raster.settings import RasterSettings

__all__ = [
    "BundleSightings",
    "OutlineState",
    "RasterState",
    "SymmetryJudge",
    "TouchState",
    "__version__",
    "beyond_planes",
    "border_distances",
    "cone_distances",
    "coverage_squares",
    "coverage_squares_backward",
    "cut_patches",
    "default_settings",
    "distances",
    "finger_costs_backward",
    "finger_costs_forward",
    "fma_peak_gflops",
    "form_factors",
    "hand_poses_backward",
    "hand_poses_forward",
    "harmonics_backward",
    "harmonics_forward",
    "lay_patches",
    "outline_backward",
    "outline_forward",
    "pose_backward",
    "pose_forward",
    "rasterize_backward",
    "rasterize_forward",
    "rotations_backward",
    "rotations_forward",
    "simd_level",
    "terms_alone",
    "terms_alone_backward",
    "terms_together",
    "terms_together_backward",
    "time_engine",
    "times_empty",
    "times_seen",
    "touch_backward",
    "touch_forward",
    "tree_backward",
    "tree_forward",
]

__version__: str

# Every array is C-contiguous and of one floating dtype, with leading axes that `counts` says the meaning of:
# means [.., N, 3], quats [.., N, 4], scales [.., N, 3], opacities [.., N], colors [.., N, D],
# viewmats [.., 4, 4], Ks [.., 3, 3], backgrounds [.., D] or None, pixel_mask [.., H, W] of bool or None.
_Arrays = tuple[
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any] | None,
    NDArray[np.bool_] | None,
]

# Of each array, batch entries and cameras that its leading axes stand for; 1 is shared, or absent.
_Counts = tuple[tuple[int, int], ...]

@final
class RasterState:
    """What the forward pass keeps for the backward pass. Opaque; usable any number of times."""

    def median_ids(self, lead: tuple[int, ...], width: int, height: int) -> NDArray[np.int32]:
        """For every pixel the Gaussian at which half its light is gone, or −1: [*lead, height, width]."""

    def counters(self) -> dict[str, int]:
        """Work done and skipped in the forward pass, summed over the views."""

def rasterize_forward(
    arrays: _Arrays,
    counts: _Counts,
    lead: tuple[int, ...],
    width: int,
    height: int,
    settings: RasterSettings,
    render_mode: str,
    camera_model: str,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[np.int32], RasterState]:
    """Colors [*lead, H, W, D], alphas [.., H, W, 1], means2d [.., N, 2], depths [.., N], radii, state."""

def rasterize_backward(
    state: RasterState,
    arrays: tuple[NDArray[Any], ...],
    counts: _Counts,
    v_colors: NDArray[Any] | None,
    v_alphas: NDArray[Any] | None,
    wanted: tuple[bool, ...],
) -> tuple[
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    int,
]:
    """Flat gradients of the seven differentiable inputs, of means2d, its absolute form, and tiles skipped.

    `arrays` and `counts` are those of the Gaussians, the first five of the forward call that made the state.
    """

# dirs [.., N, 3], coeffs [N, K, 3], mask [.., N] of bool or None: all Gaussians of one place, then the next.
_HarmonicsArrays = tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_] | None]

def harmonics_forward(degree: int, arrays: _HarmonicsArrays) -> NDArray[Any]:
    """Colours of the directions, flat."""

def harmonics_backward(
    degree: int, arrays: _HarmonicsArrays, v_colors: NDArray[Any], wanted: list[bool]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Flat gradients of dirs and coeffs; what is not wanted is an empty array."""

# Of a subject: points [N, 3] or [B, N, 3], weights [N, K], bones [B, K, 3 or 4, 4], quats [N, 4] or None,
# albedo [N, 3] or None, parts [N, J] or None, shade [B, 4 + J] or None, occlusion [B, N] or None,
# ambient [3] or None, whether it is mirrored.
_Posing = tuple[
    NDArray[Any],
    NDArray[Any],
    NDArray[Any],
    NDArray[Any] | None,
    NDArray[Any] | None,
    NDArray[Any] | None,
    NDArray[Any] | None,
    NDArray[Any] | None,
    NDArray[Any] | None,
    bool,
]

def pose_forward(
    frames: int, subjects: list[_Posing], clip: NDArray[Any] | None, labels: bool
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Flat means, quats and colours of all subjects in `frames` frames; clip is [8, 3]."""

def pose_backward(
    frames: int,
    subjects: list[_Posing],
    clip: NDArray[Any] | None,
    labels: bool,
    pulls: list[NDArray[Any] | None],
    wanted: list[list[bool]],
) -> tuple[list[tuple[NDArray[Any], ...]], NDArray[Any]]:
    """Flat gradients of each subject's points, weights, bones, quats, albedo, shade and ambient, and of clip.

    `pulls` are those of means, quats and colours; what is not wanted is an empty array.
    """

def form_factors(arrays: tuple[NDArray[Any], ...]) -> NDArray[Any]:
    """Flat sums of form factors at places in B frames.

    `arrays` are points and normals [B, N, 3], those of the discs [B, M, 3], and their areas [M].
    """

@final
class OutlineState:
    """What a mesh covers, for the backward pass. Opaque; usable any number of times."""

# Triangles [F, 3], and width and height of the picture.
_OutlineOptions = tuple[NDArray[np.int64], tuple[int, int]]

def outline_forward(
    arrays: tuple[NDArray[Any], ...], options: _OutlineOptions
) -> tuple[NDArray[Any], OutlineState]:
    """Flat shares [B, H, W] of pixels that a mesh covers; `arrays` are points [B, V, 3] and K [3, 3]."""

def outline_backward(
    state: OutlineState,
    arrays: tuple[NDArray[Any], ...],
    options: _OutlineOptions,
    v_shares: NDArray[Any],
) -> NDArray[Any]:
    """The flat gradient of the points from that of the shares."""

def terms_together(
    arrays: tuple[NDArray[Any], ...], frames: tuple[int, ...], covered: float
) -> tuple[list[float], list[float]]:
    """Four terms of pictures of all subjects together, and the two areas that they are means over.

    `arrays` are colors [B, H, W, D], alphas [B, H, W, 1], images [T, H, W, 3], foreground, unknown and the
    labels' shares [T, H, W].
    """

def terms_together_backward(
    arrays: tuple[NDArray[Any], ...],
    frames: tuple[int, ...],
    covered: float,
    areas: list[float],
    v: list[float],
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Flat gradients of colors and alphas from those of the terms."""

def coverage_squares(arrays: tuple[NDArray[Any], ...], frames: tuple[int, ...]) -> list[float]:
    """The squared distance [B] of each picture's coverage from what masks allow, summed over its pixels.

    `arrays` are alphas [B, H, W], own and hidden [T, H, W].
    """

def coverage_squares_backward(
    arrays: tuple[NDArray[Any], ...], frames: tuple[int, ...], v: list[float]
) -> NDArray[Any]:
    """The flat gradient of alphas from that of the pictures' sums."""

def terms_alone(
    arrays: tuple[NDArray[Any] | None, ...], frames: tuple[int, ...]
) -> tuple[list[float], float]:
    """Three terms of pictures of one subject alone, and the area that they are means over.

    `arrays` are alphas [B, H, W, 1], colors [B, H, W, 3] or None, images [T, H, W, 3], own and hidden
    [T, H, W].
    """

def terms_alone_backward(
    arrays: tuple[NDArray[Any] | None, ...], frames: tuple[int, ...], area: float, v: list[float]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Flat gradients of colors, empty where there are none, and of alphas from those of the terms."""

def cut_patches(
    picture: NDArray[np.float32], places: NDArray[np.float32], half: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Flat grey values, slopes and weights of patches about places [N, 2] of a picture [2, H, W]."""

def lay_patches(
    picture: NDArray[np.float32],
    templates: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    starts: NDArray[np.float32],
    warps: NDArray[np.float32],
    half: int,
    iterations: int,
    limits: tuple[float, float, float, float],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Flat places at which patches come to lie on a picture [2, H, W], their covariances, and which fit.

    A covariance has three numbers: right right, right down, down down.

    Templates are grey values [N, S], slopes [N, S, 2] and weights [N, S]; starts [N, 2], warps [N, 2, 2].
    `limits` are the least share shown, the least likeness, the most moved and the most unsure, in pixels.
    """

def rotations_forward(arrays: tuple[NDArray[Any]]) -> NDArray[Any]:
    """Flat matrices of rotation vectors [.., 3], the only entry."""

def rotations_backward(arrays: tuple[NDArray[Any], NDArray[Any]]) -> NDArray[Any]:
    """Flat gradients of vectors [.., 3] from those of their matrices [.., 3, 3]."""

# base_orient [T, 3, 3], base_pose [T, J, 3, 3], base_ray [T, 2], base_log_depth [T], orient [T, 3],
# pose [T, J, 3], pose_bias [J, 3], ray [T, 2], log_depth [T].
_HandPoses = tuple[NDArray[Any], ...]
# None, or (base_orient [G, 3, 3], base_pose [G, J, 3, 3], base_position [G, 3], orient [G, 3],
# pose [G, J, 3], position [G, 3], rotations [B, 3, 3], centers [B, 3], scale []), of_frame [T], slack and
# whether the hand is mirrored.
_Carried = tuple[tuple[NDArray[Any], ...], NDArray[np.int64], float, bool] | None

def hand_poses_forward(
    arrays: _HandPoses, frames: list[int], carried: _Carried
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Flat rotations [B, 3, 3] and [B, J, 3, 3] and wrists [B, 3] of some of T frames."""

def hand_poses_backward(
    arrays: _HandPoses, frames: list[int], carried: _Carried, pulls: list[NDArray[Any] | None]
) -> tuple[tuple[NDArray[Any], ...], tuple[NDArray[Any], ...] | None]:
    """Flat gradients of what was learned of frames, and of grasps and what carries them."""

# hand_pose [B, 15, 3, 3], turns [M, 15, 3, 3], bends [2, 2, 4, 15, 3, 3].
_Fingers = tuple[NDArray[Any], ...]

def finger_costs_forward(arrays: _Fingers) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Unevenness, squared impossible turns and departures from coupled bends, an array of one value each."""

def finger_costs_backward(arrays: _Fingers, pulls: list[float]) -> NDArray[Any]:
    """Flat gradients of hand_pose from those of the three costs."""

# rotations [B, K, 3, 3], rest_joints [K, 3] or [B, K, 3], root [B, 3].
_Tree = tuple[NDArray[Any], ...]

def tree_forward(arrays: _Tree, parents: tuple[int, ...]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Flat joints [B, K, 3] and bones [B, K, 4, 4]."""

def tree_backward(
    arrays: _Tree, parents: tuple[int, ...], pulls: list[NDArray[Any] | None]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Flat gradients of rotations, rest_joints and root from those of joints and bones."""

def distances(arrays: tuple[NDArray[Any], ...]) -> NDArray[Any]:
    """Flat distances of points [.., 3] from values [Z, Y, X] within bounds [2, 3]."""

@final
class TouchState:
    """What touches, for the backward pass. Opaque; usable any number of times."""

# points [V, 3] or [B, V, 3], weights [V, K], bones [B, K, 4, 4], rotations [B, 3, 3], centers [B, 3],
# scale [], values [Z, Y, X], bounds [2, 3].
_Touch = tuple[NDArray[Any], ...]
# Whether the hand is mirrored, for each of G groups how many of which vertices count, and the tolerance.
_TouchOptions = tuple[bool, tuple[tuple[int, tuple[int, ...] | None], ...], float]

def touch_forward(arrays: _Touch, options: _TouchOptions) -> tuple[NDArray[Any], NDArray[Any], TouchState]:
    """Flat depths [B, G] and sums of squares [B] of what is sunk."""

def touch_backward(
    state: TouchState, arrays: _Touch, options: _TouchOptions, pulls: list[NDArray[Any] | None]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Flat gradients of points, bones, rotations, centers and scale from those of depths and sums."""

# Focal lengths and principal point, rotations [T, 9], centres [T, 3].
_Poses = tuple[tuple[float, float, float, float], NDArray[np.float64], NDArray[np.float64]]

def cone_distances(
    silhouettes: NDArray[np.float32],
    poses: _Poses,
    points: NDArray[np.float64],
    order: list[int],
    agreeing: int,
    stop: float,
) -> NDArray[np.float64]:
    """Distances [N] of points [N, 3] to the visual hull of silhouettes [T, H, W]."""

def times_seen(
    shown: NDArray[np.bool_],
    poses: _Poses,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    surface: NDArray[np.float64],
    least_cosine: float,
    tolerance: float,
) -> NDArray[np.uint32]:
    """In how many pictures [N] points [N, 3] of a surface show, given its normals and samples [M, 3]."""

def times_empty(
    shown: NDArray[np.bool_],
    poses: _Poses,
    points: NDArray[np.float64],
    surface: NDArray[np.float64],
    tolerance: float,
) -> NDArray[np.uint32]:
    """In how many pictures [N] points [N, 3] would hide surface [M, 3] that shows."""

def beyond_planes(points: NDArray[np.float64], planes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest signed distance [N] of points [N, 3] to planes [M, 4]: normal and offset."""

def border_distances(inside: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Signed distances [H * W] in pixels to the border of a mask [H, W], negative inside."""

@final
class NearestPoints:
    """Points among which nearest ones are found. Opaque."""

    def __new__(cls, points: NDArray[np.float64]) -> NearestPoints: ...
    def of(
        self, places: NDArray[np.float64], guesses: NDArray[np.uint32] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
        """Distance and index of the point that is nearest to each place; guesses of the indices save time."""

_Scene = tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], tuple[float, float, float, float]
]
_System = tuple[
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]

@final
class BundleSightings:
    """What was seen where, for bundle adjustment of T frames, of which F may move, and P points. Opaque.

    A scene is rotations [T, 9], transl [T, 3], points [P, 3] by rank, and fx, fy, cx, cy. A coupling of an
    observation's point with its pose has 12 numbers. `sigma` is the scale of Cauchy's loss in pixels.
    """

    def __new__(
        cls,
        frame: NDArray[np.int64],
        point: NDArray[np.int64],
        pixels: NDArray[np.float64],
        precision: NDArray[np.float64],
        free: NDArray[np.bool_],
    ) -> BundleSightings:
        """Observations by rank of their point and then by frame; `free` [T] says which frames may move."""

    def cost(self, scene: _Scene, sigma: float) -> float:
        """The sum of Cauchy's losses."""

    def linearise(self, scene: _Scene, sigma: float) -> _System:
        """Normal equations, flat: poses, their gradient, points, their gradient, couplings."""

    def border(
        self, scene: _Scene, sigma: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
        """The focal length's part of them: with the poses, with the points, second and first derivative."""

    def reduce(
        self, system: _System, damping: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """The poses' equations without the points, and the inverses of the points' matrices, flat."""

    def point_steps(
        self,
        couplings: NDArray[np.float64],
        point_gradient: NDArray[np.float64],
        inverses: NDArray[np.float64],
        change: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """How far points go when the poses go by `change` [F, 6], flat."""

    def carried(self, couplings: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """What values [P, 3] of the points do in the poses' equations [6F]."""

@final
class SymmetryJudge:
    """Judges symmetries of a surface. Opaque; symmetries are rows of a point and a direction."""

    def __new__(
        cls,
        surface: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
        empty: NDArray[np.float64],
        origin: tuple[float, ...],
        spacing: float,
        reach: float,
        least_cosine: float,
        turns: int,
        every: int,
    ) -> SymmetryJudge: ...
    def agreement(self, axes: list[bool], rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Support, contradiction and mean difference of colours, flat."""

    def refined(self, axes: list[bool], rows: NDArray[np.float64], size: float) -> NDArray[np.float64]:
        """Points and directions of the symmetries moved to what they carry onto, flat."""

def default_settings() -> dict[str, Any]:
    """The engine's own defaults, by the names of `RasterSettings`."""

def simd_level() -> str:
    """The CPU feature level the kernels run at: avx512, avx2, neon or baseline.

    Raises:
        ValueError: `BIGS_RASTER_SIMD` names none that this machine has.
    """

def fma_peak_gflops() -> float:
    """Measured peak of one thread at that level, 10⁹ float32 operations per second; a multiply-add is two."""

def time_engine(
    gaussians: list[NDArray[np.float32]],
    camera: list[NDArray[np.float32]],
    width: int,
    height: int,
    settings: RasterSettings,
    v_colors: NDArray[np.float32],
) -> list[tuple[str, float]]:
    """Wall seconds of the stages with their vjps, then of the whole calls forward and backward.

    Gaussians are means [N, 3], quats [N, 4], scales [N, 3], opacities [N], colors [N, 3]; the camera is
    viewmat [4, 4] and K [3, 3]; v_colors [H, W, 3]. All are float32 and C-contiguous.
    """
