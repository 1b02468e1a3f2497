"""Noise that differs from sample to sample: residuals in units of the covariances of a channel's samples."""

from __future__ import annotations

import numpy as np

from concent_warp.recording.recording import Channel

MIN_STD_SHARE = 0.1
"""Least standard deviation, along any direction of any sample, over the lower quartile of those of the samples [-]: one
that claims to be better counts no more than that, so that no single one decides a fit."""


def covariance_std(channel: Channel) -> float | None:
    """Return the root mean square of the standard deviations of all components of a channel's covariances, None where
    it has none.
    """
    if channel.covariance is None:
        return None
    variance = np.einsum("tii->ti", np.asarray(channel.covariance, float))
    variance = variance[np.isfinite(variance)]
    return float(np.sqrt(variance.mean())) if variance.size and variance.any() else None


def relative_whitening(channel: Channel, *, own: bool = False) -> np.ndarray | None:
    """Return matrices W that turn residuals r of a channel into W r whose noise is alike in all samples and components.

    W is the covariance to the power of -1/2 times the channel's standard deviation (`covariance_std`), so that W r has
    the unit and the size of r; the identity for a sample without covariance.

    Args:
        channel: The channel.
        own: Whether the covariances are those of what each sample has for itself, without what samples share.

    Returns:
        Shape (T, k, k), symmetric, k as in `Channel.covariance`; None where the channel has no covariance.
    """
    std = covariance_std(channel)
    if std is None:
        return None
    covariance = np.asarray(channel.covariance, float)
    if own and channel.common is not None:
        covariance = covariance - channel.common @ np.swapaxes(channel.common, 1, 2)
    known = np.isfinite(covariance).all(axis=(1, 2))
    result = np.repeat(np.eye(covariance.shape[1])[None], len(covariance), axis=0)
    variance, axes = np.linalg.eigh(covariance[known])
    usual = np.sqrt(np.quantile(np.maximum(variance, 0).mean(axis=1), 0.25))
    factor = std / np.sqrt(np.maximum(variance, (MIN_STD_SHARE * max(usual, MIN_STD_SHARE**2 * std)) ** 2))
    result[known] = np.einsum("tik,tk,tjk->tij", axes, factor, axes)
    return result


def whitened(value: np.ndarray, whitening: np.ndarray | None) -> np.ndarray:
    """Return residuals (T, k) times matrices (T, k, k); a sample with missing components stays as it is."""
    if whitening is None:
        return value
    whole = np.asarray(np.isfinite(value).all(axis=1, keepdims=True))
    return np.where(whole, np.einsum("tij,tj->ti", whitening, np.where(whole, value, 0.0)), value)
