"""Surfaces, meshes, lamps, camera and the development of a picture: what the samples' Mitsuba scenes share.

Needs Mitsuba 3 (variant llvm_ad_rgb: apt libllvm19 libatomic1) and mitsuba-oidn. Lengths in mm.
"""

from __future__ import annotations

import cv2
import mitsuba as mi
import numpy as np
import textures as tx

mi.set_variant("llvm_ad_rgb")


def bitmap(array, raw: bool):
    data = np.ascontiguousarray(array, dtype=np.float32)
    if data.ndim == 2:
        data = data[..., None]
    # Row 0 of a texture is its largest v here. Colours are linear: nothing is decoded from sRGB.
    data = np.ascontiguousarray(data[::-1])
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": raw, "wrap_mode": "repeat"}


def steel(maps, metallic: float, bump_mm: float = 0.0):
    color, rough, bump = maps
    surface = {
        "type": "principled",
        "base_color": bitmap(np.clip(color, 0.002, 0.95), True),
        "roughness": bitmap(rough, True),
        "metallic": metallic,
        "specular": 0.5,
    }
    if bump_mm == 0.0:
        return mi.load_dict({"type": "twosided", "nested": surface})
    bumped = {"type": "bumpmap", "bump": bitmap(bump, True), "scale": bump_mm, "nested": surface}
    return mi.load_dict({"type": "twosided", "nested": bumped})


def matte(color, roughness: float = 0.5, specular: float = 0.4):
    texture = bitmap(np.clip(color, 0.002, 0.95), True) if isinstance(color, np.ndarray) else {
        "type": "rgb", "value": list(color)}  # fmt: skip
    surface = {"type": "principled", "base_color": texture, "roughness": roughness, "specular": specular}
    return mi.load_dict({"type": "twosided", "nested": surface})


def corner_normals(vertices, faces, crease_deg: float):
    """(F,3,3) normals per face corner, smoothed over neighbours within the crease angle."""
    corner = vertices[faces]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
    _, merged = np.unique(np.round(vertices, 3), axis=0, return_inverse=True)
    around: dict[int, list[int]] = {}
    for face, triple in enumerate(merged.reshape(-1)[faces]):
        for vertex in triple:
            around.setdefault(int(vertex), []).append(face)
    normals = np.empty((len(faces), 3, 3))
    limit = np.cos(np.deg2rad(crease_deg))
    for face, triple in enumerate(merged.reshape(-1)[faces]):
        for k, vertex in enumerate(triple):
            near = np.array(around[int(vertex)])
            near = near[unit[near] @ unit[face] > limit]
            total = area[near].sum(axis=0)
            normals[face, k] = total / max(np.linalg.norm(total), 1e-12)
    return normals


def mesh(name, vertices, faces, surface, tile_mm=(240.0, 240.0), offset_mm=(0.0, 0.0), crease_deg=35.0):
    """Mitsuba mesh with box-projected texture coordinates and crease-aware normals."""
    corner = vertices[faces]
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    axis = np.abs(flat).argmax(axis=1)
    first, second = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
    rows = np.arange(len(faces))[:, None]
    columns = np.arange(3)[None]
    uv = np.stack([corner[rows, columns, first[:, None]], corner[rows, columns, second[:, None]]], axis=-1)
    uv = (uv + np.asarray(offset_mm) + 37.0 * (axis[:, None, None] != 2)) / np.asarray(tile_mm)
    normals = corner_normals(vertices, faces, crease_deg)
    props = mi.Properties()
    props["surface"] = surface
    out = mi.Mesh(name, 3 * len(faces), len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=props)
    params = mi.traverse(out)
    params["vertex_positions"] = mi.Float(corner.reshape(-1).astype(np.float32))
    params["vertex_normals"] = mi.Float(normals.reshape(-1).astype(np.float32))
    params["vertex_texcoords"] = mi.Float(uv.reshape(-1).astype(np.float32))
    params["faces"] = mi.UInt32(np.arange(3 * len(faces), dtype=np.uint32))
    params.update()
    return out


def page(name, surface, size, center, turn_deg):
    """A flat sheet that shows its texture exactly once, in its own orientation."""
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * (size[0] / 2, size[1] / 2, 0.0)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    sheet = mesh(name, corners @ tx.turn_z(turn_deg).T + np.asarray(center), faces, surface)
    params = mi.traverse(sheet)
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 0), (1, 1), (0, 1)], np.float32)
    params["vertex_texcoords"] = mi.Float(uv.reshape(-1))
    params.update()
    return sheet


def lamp(origin, target, size, radiance):
    """A rectangular area light at ``origin`` that shines towards ``target``."""
    to_world = mi.ScalarTransform4f().look_at(origin, target, [0, 0.01, 1])
    to_world = to_world @ mi.ScalarTransform4f().scale([size[0] / 2, size[1] / 2, 1])
    light = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return {"type": "rectangle", "to_world": to_world, "emitter": light}


def sensor(film, focal_px, aperture_mm, focus_mm):
    """A thin-lens camera without distortion on a film of (width, height) px; its pose is set later."""
    width, height = film
    return {
        "type": "thinlens",
        "fov": float(np.rad2deg(2 * np.arctan(width / 2 / focal_px))),
        "fov_axis": "x",
        "aperture_radius": aperture_mm,
        "focus_distance": focus_mm,
        "near_clip": 10.0,
        "far_clip": 9000.0,
        "film": {
            "type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"},
            "pixel_format": "rgb", "component_format": "float32",
        },
        "sampler": {"type": "independent", "sample_count": 4},
    }  # fmt: skip


def to_world(cam_from_model):
    """The ``to_world`` matrix of Mitsuba for an OpenCV pose: both look along +Z, Mitsuba with +X left and +Y up."""
    return mi.Transform4f(np.linalg.inv(cam_from_model) @ np.diag([-1.0, -1.0, 1.0, 1.0]))


def denoise(color, guide):
    """Denoise linear RGB (H,W,3), with albedo and normals in the last six channels of ``guide``."""
    import mitsuba_oidn

    color = np.minimum(np.nan_to_num(color), 30.0).astype(np.float32)
    albedo, normal = (np.ascontiguousarray(part, np.float32) for part in np.split(guide[..., -6:], 2, axis=2))
    clean = mitsuba_oidn.denoise(
        np.ascontiguousarray(color),
        albedo=np.clip(albedo, 0, 1),
        normal=normal,
        hdr=True,
        quality=mitsuba_oidn.Quality.Fast,
    )
    return np.asarray(clean)


def undistortion_maps(camera: dict, film: tuple[int, int], focal: float | None = None):
    """Position in the undistorted film of each pixel of the distorted picture, as maps for cv2.remap.

    The film has the camera's focal length or another one.
    """
    focal = focal or camera["fx"]
    u, v = np.meshgrid(np.arange(camera["width"], dtype=np.float64), np.arange(camera["height"], dtype=np.float64))
    k1, k2, *others = camera["dist"]
    assert not any(others), "only radial distortion k1, k2 is rendered"
    distorted = (u - camera["cx"]) / camera["fx"], (v - camera["cy"]) / camera["fy"]
    x, y = distorted
    for _ in range(30):
        r2 = x * x + y * y
        factor = 1.0 + r2 * (k1 + r2 * k2)
        x, y = distorted[0] / factor, distorted[1] / factor
    # The film's principal point is its middle: width / 2 counted from the edge, half a pixel less
    # counted from the middle of the first pixel.
    map_x = x * focal + film[0] / 2 - 0.5
    map_y = y * focal + film[1] / 2 - 0.5
    return map_x.astype(np.float32), map_y.astype(np.float32)


def metered(linear: np.ndarray) -> float:
    """The exposure that a phone's meter chooses, which looks most at the middle of the picture."""
    height, width = linear.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    weight = np.exp(-2.0 * (x**2 + y**2))
    light = np.maximum(linear.mean(axis=2), 0)
    middle = np.exp((weight * np.log(light + 1e-3 * light.mean())).sum() / weight.sum())
    # No more than the 97th percentile may come to the tone curve's shoulder.
    return float(min(0.22 / middle, 0.95 / max(np.percentile(light, 97), 1e-6)))


def develop(linear: np.ndarray, gain: float, rng: np.random.Generator, noise_gain: float = 1.0) -> np.ndarray:
    """Linear light to an 8-bit BGR picture: exposure, vignetting, sensor noise, tone curve, sharpening.

    ``noise_gain`` multiplies the noise's variance: 10 is that of ten times the ISO value.
    """
    height, width = linear.shape[:2]
    y, x = np.mgrid[:height, :width]
    radius = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width / 2) ** 2
    light = np.maximum(linear, 0) * (1.0 - 0.10 * radius)[..., None] * gain
    noise = rng.normal(size=light.shape).astype(np.float32)
    noise = 0.75 * noise + 0.5 * cv2.GaussianBlur(noise, (0, 0), 0.8)
    light = np.maximum(light + noise * np.sqrt(noise_gain * (2.2e-5 + 1.3e-4 * light)), 0)
    # A soft shoulder above 0.7, then the sRGB curve.
    light = np.where(light > 0.7, 0.7 + 0.3 * np.tanh((light - 0.7) / 0.6), light)
    tone = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-6) ** (1 / 2.4) - 0.055)
    tone = tone + 0.25 * (tone - cv2.GaussianBlur(tone, (0, 0), 1.0))
    return np.round(np.clip(tone, 0, 1) * 255).astype(np.uint8)[..., ::-1]
