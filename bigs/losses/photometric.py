"""How far a rendered image is from the photograph (paper Eq. 5)."""

from __future__ import annotations

from torch import Tensor

from bigs.metrics.image import ssim


def masked_l1(pred: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """||m (I_pred - I_gt)||_1 (Eq. 5), a mean over the mask's pixels and the channels.

    The paper's sum would weigh large images and near subjects more; dividing by the mask's area makes one
    weight serve every resolution.

    Args:
        pred, target: [..., 3] in [0, 1].
        mask: [...] in [0, 1].
    """
    difference = (pred - target).abs() * mask[..., None]
    return difference.sum() / (mask.sum() * pred.shape[-1]).clamp_min(1.0)


def masked_mse(pred: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Sum of m (I_pred - I_gt)^2, a mean over the mask's pixels and the channels: what PSNR measures.

    Unlike L1 it does not give up on a few pixels that are altogether wrong, such as a finger that is not
    where the image shows it.

    Args:
        pred, target: [..., 3] in [0, 1].
        mask: [...] in [0, 1].
    """
    difference = (pred - target).square() * mask[..., None]
    return difference.sum() / (mask.sum() * pred.shape[-1]).clamp_min(1.0)


def masked_ssim(pred: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """1 - SSIM(m I_pred, m I_gt) (Eq. 5), a mean over all pixels, channels and images.

    Args:
        pred, target: [B, H, W, 3] in [0, 1].
        mask: [B, H, W] in [0, 1].
    """
    pred, target = ((image * mask[..., None]).movedim(-1, 1) for image in (pred, target))
    return 1.0 - ssim(pred, target)
