"""Loss terms of rendered images: each subject alone, or all together as the paper's second step has them."""

from __future__ import annotations

from torch import Tensor

from bigs.losses.mask import outside_mask, outside_mask_on
from bigs.losses.perceptual import masked_perceptual
from bigs.losses.photometric import masked_ssim
from bigs.losses.weighted import mean_of
from bigs.train.loop.step import Step


def image_alone(step: Step) -> Tensor:
    """|I - I*| of the paper (Eq. 5) over the pixels that each subject shows, a mean over subjects."""
    return mean_of(step.alone_terms(entity).image for entity in step.entities)


def mse_alone(step: Step) -> Tensor:
    """(I - I*)² over the pixels that each subject shows, a mean over subjects."""
    return mean_of(step.alone_terms(entity).mse for entity in step.entities)


def ssim_alone(step: Step) -> Tensor:
    """1 - SSIM of each subject inside its own mask (paper Eq. 5), a mean over subjects."""
    return mean_of(
        masked_ssim(step.alone(entity).colors, step.images_alone(entity), step.share_alone(entity))
        for entity in step.entities
    )


def mask_alone(step: Step) -> Tensor:
    """The paper's mask regulariser (1 - m) I (Eq. 5) of each subject alone; m is the union of all masks."""
    return mean_of(
        outside_mask(step.alone(entity).colors, step.foreground_alone(entity)) for entity in step.entities
    )


def mask_random_alone(step: Step) -> Tensor:
    """`mask` over a random colour, as in the released code: black Gaussians cannot hide outside m."""
    generator = step.generator()
    return mean_of(
        outside_mask_on(
            step.alone(entity).colors,
            step.alone(entity).alphas,
            step.foreground_alone(entity),
            generator,
        )
        for entity in step.entities
    )


def perceptual_alone(step: Step) -> Tensor:
    """VGG-16 or LPIPS distance of patches of each subject (paper Eq. 5), a mean over subjects."""
    generator = step.generator()
    return mean_of(
        masked_perceptual(
            step.alone(entity).colors,
            step.images_alone(entity),
            step.share_alone(entity),
            step.evidence.perceptual,
            generator,
        )
        for entity in step.entities
    )


def coverage_alone(step: Step) -> Tensor:
    """Each subject opaque on its own pixels, absent from the background, free where others may hide it."""
    return mean_of(step.alone_terms(entity).coverage for entity in step.entities)


def image_together(step: Step) -> Tensor:
    """|I - I*| of the paper (Eq. 9) over the pixels that show any subject."""
    return step.together_terms.image


def mse_together(step: Step) -> Tensor:
    """(I - I*)² over the pixels that show any subject."""
    return step.together_terms.mse


def ssim_together(step: Step) -> Tensor:
    """1 - SSIM inside the union of all masks (paper Eq. 9)."""
    return masked_ssim(step.together.colors[..., :3], step.images, step.foreground)


def mask_together(step: Step) -> Tensor:
    """The paper's mask regulariser (1 - m) I, also where sleeves are; `alpha_outside` leaves those out."""
    return outside_mask(step.together.colors[..., :3], step.foreground)


def alpha_outside(step: Step) -> Tensor:
    """Squared alpha outside all masks, per pixel of the masks, without what something unlabelled covers."""
    return step.together_terms.alpha_outside


def mask_random_together(step: Step) -> Tensor:
    """`mask` over a random colour, as in the released code."""
    rendered = step.together
    return outside_mask_on(rendered.colors[..., :3], rendered.alphas, step.foreground, step.generator())


def perceptual_together(step: Step) -> Tensor:
    """VGG-16 or LPIPS distance of patches inside the union of all masks (paper Eq. 9)."""
    return masked_perceptual(
        step.together.colors[..., :3],
        step.images,
        step.foreground,
        step.evidence.perceptual,
        step.generator(),
    )


def labels(step: Step) -> Tensor:
    """Squared difference of label channels and masks: which subject each pixel shows, occlusion included."""
    return step.together_terms.labels
