"""Motion in the clip: poses of the hand-held camera, the hand and the card at any time (frames, mid-exposure)."""

from __future__ import annotations

import numpy as np
from textures import smoothstep, turn_z

FRAMES = 300
FPS = 30
# Frame spans of the events in the clip; the visible share of each frame is measured and stored in truth.json.
HAND = (52, 118)
CARD = (132, 174)
PAN = (198, 256)
CENTER = np.array([0.0, 0.0, 26.0])


def _tremor(t, seed: int, low_hz=0.4, high_hz=7.0):
    """Smooth random motion of unit size, six channels: (6,)."""
    rng = np.random.default_rng(seed)
    frequency = np.geomspace(low_hz, high_hz, 9)
    phase = rng.uniform(0, 2 * np.pi, (6, 9))
    weight = frequency**-0.9
    weight /= np.sqrt(np.sum(weight**2) / 2)
    return np.sin(2 * np.pi * frequency * t / FPS + phase) @ weight


def _pulse(t, begin, end, ramp):
    """0 outside a span and 1 inside, with smooth ramps of some frames within it."""
    return smoothstep(t, begin, begin + ramp) * (1.0 - smoothstep(t, end - ramp, end))


def _rotation(axis: int, angle_deg: float):
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    rotation = np.eye(3)
    rotation[i, i], rotation[i, j], rotation[j, i], rotation[j, j] = c, -s, s, c
    return rotation


def cam_from_model(t: float):
    """(4,4) OpenCV camera pose in mm at time ``t`` in frames."""
    u = t / (FRAMES - 1)
    azimuth = np.deg2rad(-122.0 + 76.0 * (u + 0.045 * np.sin(4 * np.pi * u)))
    elevation = np.deg2rad(41.0 + 8.5 * np.sin(2 * np.pi * (0.9 * u + 0.12)) + 2.0 * np.sin(9.0 * u))
    distance = 510.0 + 34.0 * np.sin(2 * np.pi * (1.1 * u + 0.30)) + 6.0 * np.sin(17.0 * u)
    out = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    shake = _tremor(t, 11)
    position = CENTER + distance * out + 0.9 * shake[:3]
    target = CENTER + 9.0 * np.array((np.sin(7 * u + 1), np.cos(5 * u), 0.0))
    forward = target - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    away = _pulse(t, PAN[0], PAN[1], 25.0)
    yaw = 58.0 * away + 0.16 * shake[3]
    pitch = 7.0 * away + 0.16 * shake[4]
    roll = 3.5 * np.sin(6.3 * u + 0.4) + 5.0 * away + 0.18 * shake[5]
    rotation = _rotation(2, roll) @ _rotation(0, -pitch) @ _rotation(1, -yaw) @ rotation
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ position
    return pose


def hand_in_model(t: float):
    """(4,4) of the hand mesh in the model frame, or None while it is far away."""
    if not HAND[0] - 1 <= t <= HAND[1] + 1:
        return None
    u = np.clip((t - HAND[0]) / (HAND[1] - HAND[0]), 0, 1)
    # Wrist: comes from the right front, rests over the right half of the part, leaves the way it came.
    keys_u = [0.0, 0.22, 0.40, 0.55, 0.72, 1.0]
    keys = np.array([(420, -330, 120), (190, -170, 75), (70, -85, 62), (40, -95, 58), (95, -120, 66), (430, -340, 130)])
    from scipy.interpolate import PchipInterpolator

    wrist = PchipInterpolator(keys_u, keys)(u) + 0.8 * _tremor(t, 23)[:3]
    pose = np.eye(4)
    turn = 42.0 + 14.0 * np.sin(np.pi * u) + 0.5 * _tremor(t, 29)[3]
    pose[:3, :3] = turn_z(turn) @ _rotation(1, -10.0 + 8.0 * u)
    pose[:3, 3] = wrist
    return pose


def card_in_cam(t: float):
    """(4,4) of the card (lying in its own XY plane) in the camera frame, or None while it is away."""
    if not CARD[0] <= t <= CARD[1]:
        return None
    inside = _pulse(t, CARD[0], CARD[1], 9.0)
    sway = _tremor(t, 31)
    pose = np.eye(4)
    pose[:3, :3] = _rotation(2, -4.0 + 14.0 * (1 - inside) + 0.4 * sway[0]) @ _rotation(1, 6.0 + sway[1])
    pose[:3, :3] = pose[:3, :3] @ _rotation(0, 183.0 + 0.8 * sway[2])
    pose[:3, 3] = (-260.0 * (1.0 - inside) + 1.2 * sway[3], 8.0 + 1.2 * sway[4], 236.0 + 1.5 * sway[5])
    return pose


def exposure_gain(t: float) -> float:
    """Slow drift of the automatic exposure."""
    u = t / FRAMES
    return float(1.0 + 0.07 * np.sin(2 * np.pi * 1.3 * u + 0.5) + 0.04 * np.sin(2 * np.pi * 3.1 * u))
