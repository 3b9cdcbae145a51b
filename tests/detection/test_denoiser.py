"""The denoiser: estimates the noise level, removes most of the noise, and moves no edge."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from arview.detection.features.denoiser import Denoiser, noise_level
from arview.detection.search.local_search import LocalSearch
from helpers.synthetic import CAMERA, assembly_views, background, pose_from
from helpers.synthetic import picture as drawn

POSE = pose_from(30.0, 45.0, 520.0)


@cache
def network() -> Denoiser:
    return Denoiser()


def noisy(image: NDArray[np.uint8], noise: float, seed: int = 0) -> NDArray[np.uint8]:
    grain = np.random.default_rng(seed).normal(0.0, noise, image.shape)
    return np.clip(np.round(image + grain), 0, 255).astype(np.uint8)


@cache
def blurred_by_a_lens() -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(drawn(POSE, noise=0.0), (0, 0), 0.8), dtype=np.uint8)


def off(image: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """RMS difference in grey levels."""
    return float(np.sqrt(np.mean((image.astype(float) - truth) ** 2)))


@pytest.mark.parametrize("noise", [5.0, 10.0, 18.0])
def test_the_noise_level_is_estimated(noise: float) -> None:
    smooth = cv2.GaussianBlur(background(3), (0, 0), 1.5)
    # The noise of the background itself adds to it.
    assert noise_level(noisy(smooth, noise)) == pytest.approx(np.hypot(noise, noise_level(smooth)), rel=0.1)


def test_saturated_and_black_areas_do_not_hide_noise() -> None:
    image = np.full((240, 320, 3), 120, dtype=np.uint8)
    image[:, 100:] = 255
    image[:, 200:] = 0
    grainy = noisy(image, 9.0)
    assert noise_level(grainy) == pytest.approx(9.0, rel=0.25)
    assert noise_level(np.full((240, 320, 3), 255, dtype=np.uint8)) == 0.0


def slopes(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Gradient magnitude (H,W) in grey levels per pixel."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    across, down = (cv2.Sobel(gray, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    return np.hypot(across, down)


@pytest.mark.parametrize("noise", [8.0, 14.0])
def test_most_noise_is_removed_and_edges_stay_sharp(noise: float) -> None:
    truth = blurred_by_a_lens()
    grainy = noisy(truth, noise)
    clean = network().denoise(grainy)
    assert clean.shape == truth.shape and clean.dtype == np.uint8
    at_edges = slopes(truth) > 10.0
    away = cv2.dilate(at_edges.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    assert off(clean, truth) < 0.55 * off(grainy, truth)
    assert off(clean[away], truth[away]) < 0.4 * off(grainy[away], truth[away])
    # Smoothing that leaves as little noise flattens them.
    smoothed = cv2.GaussianBlur(grainy, (0, 0), 1.3)
    assert np.mean(slopes(clean)[at_edges]) > 0.8 * np.mean(slopes(truth)[at_edges])
    assert np.mean(slopes(smoothed)[at_edges]) < 0.7 * np.mean(slopes(truth)[at_edges])


def test_edges_do_not_move() -> None:
    ramp = np.clip((np.arange(320) - 160.3) + 0.5, 0.0, 1.0)
    truth = np.round(70.0 + 110.0 * np.tile(ramp, (240, 1)))[..., None].repeat(3, axis=2).astype(np.uint8)
    clean = network().denoise(noisy(truth, 12.0)).mean(axis=2)
    # Where each row crosses the middle grey.
    near = clean[8:-8, 150:172]
    right = np.argmax(near > 125.0, axis=1)
    rows = np.arange(len(near))
    left_of, right_of = near[rows, right - 1], near[rows, right]
    crossing = 150.0 + right - 1 + (125.0 - left_of) / (right_of - left_of)
    assert np.mean(crossing) == pytest.approx(160.3, abs=0.1)
    assert np.std(crossing) < 0.25


def test_images_with_little_noise_are_returned_unchanged() -> None:
    image = cv2.GaussianBlur(drawn(POSE, noise=0.0), (0, 0), 0.7)
    for noise in (0.0, 1.5):
        grainy = noisy(image, noise)
        assert noise_level(grainy) < DenoiserOptions().min_noise
        assert network().denoise(grainy) is grainy


@pytest.mark.parametrize("size", [(97, 131), (8, 8), (3, 5), (40, 600)])
def test_any_size_is_denoised(size: tuple[int, int]) -> None:
    clean = network().denoise(noisy(np.full((*size, 3), 128, dtype=np.uint8), 15.0))
    assert clean.shape == (*size, 3)
    assert np.std(clean.astype(float)) < 11.0


def test_bands_leave_no_seams() -> None:
    image = noisy(drawn(POSE, noise=0.0), 12.0)
    assert image.shape[0] == CAMERA.height <= DenoiserOptions().band_rows
    whole = network().denoise(image)
    banded = Denoiser(DenoiserOptions(band_rows=96)).denoise(image)
    assert np.max(np.abs(banded.astype(int) - whole)) <= 1


def test_searches_use_denoised_images() -> None:
    truth = blurred_by_a_lens()
    grainy = noisy(truth, 14.0)
    seen = LocalSearch(assembly_views(), CAMERA).pyramid(grainy).image
    assert off(seen, truth) < 0.5 * off(grainy, truth)
