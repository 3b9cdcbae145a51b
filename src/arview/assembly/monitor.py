"""Is every component where the CAD has it? A part of the same family may hold the pose with one component wrong.

The base and all other components hold the pose, so a component that is missing, elsewhere or another one leaves its
own edges empty. For each component that a direction shows, a look measures how many points of its outline and design
edges lie on an edge of the picture, how many would if it stood somewhere else within reach, and how the colours change
across its outline; whether the edges around it are seen says if anything could be seen there at all. A logistic model
of these makes the log-likelihood ratio of "not there" to "there"; ratios add up over looks from new directions.

Score maps over shifts of an edge template are Borgefors' (PAMI 1988) and those of `matching`; adding up log-likelihood
ratios until a threshold is Wald's sequential test (1945). The measures and the model are our own; its constants were
fitted by logistic regression to 9,000 looks at components that were right, missing, moved by 20 mm or swapped, in
half of semi-synthetic pictures of two assemblies and half of recordings of two steel plates whose CAD was changed
instead. One set of constants serves all parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.assembly.placement_search import ElsewhereSearch, other_places
from arview.assembly.presence_net import ComponentNetwork, component_looks
from arview.cad.model import Model
from arview.camera import Camera
from arview.core.kernel import kernel
from arview.detection.features.edge_net import EdgeNet
from arview.geometry import Array, apply, rigid
from arview.guideviews import GuideViewSet
from arview.guideviews.mesh_edges import facing, mesh_edges
from arview.refinement.projection import intrinsics_of, project_lines
from arview.rendering.renderers import ZBufferRenderer

LARGEST_PX = 400.0
"""Larger pictures of the part are shrunk to about this: more says no more of where a component is."""
POINTS, LEAST_POINTS = 48, 14
"""Points looked at per component; with fewer nothing is said of it."""
WEAKEST_STEP = 1.5
"""Weakest edge, grey levels per px of the strongest channel."""
DISPLACED_MM, DISPLACED_SHARE, POSE_PX = 2.5, 0.02, 1.0
"""A component may stand this far from nominal (no more than the share of the part's diameter), its pose this far."""
SEARCHED_MM, SEARCHED_SHARE, SEARCHED_PX = 24.0, 0.15, 44.0
"""Other places of a component are looked for as far as this."""
SHIFT_COST = 0.2
"""Share of points that a shift to the rim of what is allowed must gain."""
SEEN_WELL = 0.8
"""A component with so many points borne out is not looked for elsewhere; `USUAL_ELSEWHERE` stands for it."""
USUAL_ELSEWHERE = 0.45
SHARED_PX, SHARED_COS = 3.0, 0.87
"""Points this near a parallel edge of another component are no evidence for either."""
OCCLUDER_PX = 2
"""Points this near something in front of them may be hidden at a direction between two sheets."""
SIDE_PX = 4.0
"""How far beside an edge it is asked which component is there."""
COLOUR_PX = 3.0
"""How far beside an edge colours are compared."""
HALF_LAMBDA = 15.0
"""A component is half reliable when its points, weighed by the direction they say least about, are so many."""
SURROUNDINGS, LEAST_SURROUNDINGS = 16, 8
"""Points of other components around one, that say whether it is hidden by something that is not in the CAD."""
HIDDEN_SHARE, CLEAR_SHARE = 0.42, 0.67
"""Shares of the surroundings, and of the whole part, that are borne out where it is hidden and where it is not."""
MODEL = (14.3, -11.5, -13.9, -1.29)
"""Log-likelihood ratio: constant; share borne out; that less the best elsewhere; colour contrast up to 6."""
SETTLED = -2.0
"""A component with a ratio below is as expected: the network is not asked, which is less sure on real pictures."""
ELSEWHERE_EDGES = 0.8
"""What edges say for a component's place counts so much against its standing elsewhere, which the network alone says:
in pictures of other random assemblies half of the right ones that it saw elsewhere had theirs borne out."""
BOTH, MOST_SAID = (-0.11, 0.35, 1.15, 0.5), 4.0
"""Log-likelihood ratio by edges and network: constant, what edges count, the network against a component and for it;
up to how much each. Fitted to 4,200 looks at components of random assemblies that the network was not fitted to, a
tenth of them wrong, a third of the pictures with something before a component: of the wrong ones 54 % are above 99 % of
the right, by edges alone 8 %. Edges that are not seen count only as far as those around are; the network sees itself
what hides a component."""
HIDDEN_DOUBT = 2.4
"""So much less the network says against a component around which nothing is borne out: of what a hand hides it is not
sure either, and a single picture names none."""
EDGES_ALONE = 0.35
"""Of a ratio against a component that the network cannot see, so small it is, this share counts: in those pictures
what lies around it and before it leaves its edges empty oftener than where `MODEL` was fitted."""
MOST_CONTRAST, USUAL_CONTRAST = 6.0, 5.0
"""The latter stands for components without an outline of their own."""
SUSPECTS = 2
"""One thing wrong is likelier than many: each suspect beyond these halves what is said against all of them."""
LARGEST_RATIO = 4.0
"""A single look says no more than this."""
NAMED, CLEARED = 2.4, 0.1
"""Evidence above which a component is named, and below which it no longer is nor is in doubt. Of 255 frames of
look-alikes 230 are named and 7 in order by these; of 1,091 of right assemblies, with noise and an occluder, in none
one is named and 29 are in doubt, hardly seen or ambiguous."""
SEEN = -4.0
"""Evidence below which a component has been seen surely: it is not there in one of 50. Of 7 look-alikes in 255 single
pictures that are in order by the bounds above the wrong component is above it in all, and above -3 in six; of right
assemblies of 11 components 4 are above it in a single picture, and none after 144 frames of a tumbling part."""
LARGEST_NEWS = 2.3
"""What one look says against a component it does not name: of one that comes into view only a little shows at first."""
SUSPECT = 1.0
"""A look's ratio above which a component is a suspect, be it hidden or not."""
BOUND = 6.0
"""Evidence is kept within ± this."""
SINGLE = 1.8
"""A single picture's ratio above which a component is named."""
CLEARING = 0.5
"""What a direction says for a component that was named counts so much: one that was moved looks right along the way it
moved."""
FORGETTING = 0.01
"""Share of the evidence that is lost with every look."""
NEW_DIRECTION_DEG = 6.0
REPEATED_NEWS, LEAST_NEWS = 0.35, 0.03
"""Looks from about the same direction say the same: the n-th adds 0.35ⁿ⁻¹ to what their average counts, but from the
fifth on 3 %."""
EAGER_LOOKS = 2
"""So many frames after a lock are looked at, and no component is named before: noise is another in each."""
SURE = -1.0
"""Evidence below which a component has been seen."""
SUSPICIOUS_FRAMES, OPEN_FRAMES, REST_FRAMES = 6, 15, 45
"""Frames between looks while a component may be wrong, has not been seen, and while all are as expected.

The first two hold for new directions; from one that was looked from before it takes one step longer. A direction that
shows a component not seen yet counts as one from which it may be wrong.
"""
FRESH_LOOKS = 6
"""A direction is new in so many looks while a component may be wrong: the first ones may have been blurred."""
KEPT_SHEETS = 64


@dataclass(frozen=True)
class ComponentSheet:
    """Edges of all components as one direction shows them, sorted by component.

    Attributes:
        points_in_body, tangents: (N,3) float32 mm about the model's centre, and unit.
        component: (N,) int16.
        sides: (N,2) int16 component seen beside the edge, against and along its normal; -1: none.
        is_own: (N,) not on an edge of another component nor beside something in front.
        starts: (C+1,) first point of each component.
    """

    points_in_body: NDArray[np.float32]
    tangents: NDArray[np.float32]
    component: NDArray[np.int16]
    sides: NDArray[np.int16]
    is_own: NDArray[np.bool_]
    starts: NDArray[np.int64]


@dataclass(frozen=True)
class Look:
    """What one picture says of the components.

    Attributes:
        against: (C,) log-likelihood ratio of "not where expected" to "as expected"; 0 where nothing is said.
        is_suspect: (C,) its edges are not seen, it may be hidden; or it is seen elsewhere.
        is_shown: (C,) enough of it shows to say something.
        borne_out, elsewhere: (C,) share of its points on edges of the picture, at its place and at the best other.
        contrast: (C,) mean change of colour across its outline in deviations, -1 where there is none.
        surroundings: (C,) share of the points around it that is borne out.
    """

    against: Array
    is_suspect: NDArray[np.bool_]
    is_shown: NDArray[np.bool_]
    borne_out: Array
    elsewhere: Array
    contrast: Array
    surroundings: Array


@kernel
def _sample_edges(  # type: ignore[no-untyped-def]
    vertices, ends, faces, is_sharp, normals, component, cam_from_model, focal, middle, ids, depth, tolerance_mm
):  # fmt: skip
    """Samples every pixel along visible design edges and silhouettes of a view.

    As `mesh_edges.sample_visible_edges`, but a silhouette is also seen where the surface beside it curves towards the
    camera by more than the tolerance: thin cylinders.

    Returns:
        points (N,3) mm, tangents (N,3), pixels (N,2), image normals (N,2), depths (N,), component (N,).
    """
    height, width = ids.shape
    r = cam_from_model
    eye = np.empty(3)
    for k in range(3):
        eye[k] = -(r[0, k] * r[0, 3] + r[1, k] * r[1, 3] + r[2, k] * r[2, 3])
    a_cam = np.empty(3)
    b_cam = np.empty(3)
    capacity = 4096
    points = np.empty((capacity, 3))
    tangents = np.empty((capacity, 3))
    pixels = np.empty((capacity, 2))
    normals_px = np.empty((capacity, 2))
    depths = np.empty(capacity)
    owners = np.empty(capacity, dtype=np.int16)
    found = 0
    carry = 0.5
    for e in range(ends.shape[0]):
        a = vertices[ends[e, 0]]
        b = vertices[ends[e, 1]]
        f0, f1 = faces[e, 0], faces[e, 1]
        front0, front1 = facing(eye, a, normals, f0, f1)
        silhouette = f1 < 0 or (front0 > 0) != (front1 > 0)
        if not (silhouette or (is_sharp[e] and front0 > 0)):
            continue
        for k in range(3):
            a_cam[k] = r[k, 0] * a[0] + r[k, 1] * a[1] + r[k, 2] * a[2] + r[k, 3]
            b_cam[k] = r[k, 0] * b[0] + r[k, 1] * b[1] + r[k, 2] * b[2] + r[k, 3]
        if a_cam[2] < 1.0 or b_cam[2] < 1.0:
            continue
        du = focal * (b_cam[0] / b_cam[2] - a_cam[0] / a_cam[2])
        dv = focal * (b_cam[1] / b_cam[2] - a_cam[1] / a_cam[2])
        length = np.sqrt(du * du + dv * dv)
        size = np.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
        # Edges along the line of sight have no direction in the picture.
        if length < 0.05 * focal * size / a_cam[2]:
            continue
        wanted = length + carry
        count = int(wanted)
        carry = wanted - count
        c = component[e]
        for i in range(count):
            t = (i + 0.5) / count
            z = a_cam[2] + t * (b_cam[2] - a_cam[2])
            u = focal * (a_cam[0] + t * (b_cam[0] - a_cam[0])) / z + middle
            v = focal * (a_cam[1] + t * (b_cam[1] - a_cam[1])) / z + middle
            iu, iv = int(np.round(u)), int(np.round(v))
            if iu < 1 or iv < 1 or iu >= width - 1 or iv >= height - 1:
                continue
            on_surface = False
            beside = False
            open_side = False
            for y in range(iv - 1, iv + 2):
                for x in range(iu - 1, iu + 2):
                    d = depth[y, x]
                    if ids[y, x] == c:
                        if abs(z - d) < tolerance_mm:
                            on_surface = True
                        elif d < z:
                            beside = True
                    elif ids[y, x] < 0 or d > z - tolerance_mm:
                        open_side = True
            if not (on_surface or (silhouette and beside and open_side)):
                continue
            if found == capacity:
                capacity *= 2
                points = np.concatenate((points, np.empty_like(points)))
                tangents = np.concatenate((tangents, np.empty_like(tangents)))
                pixels = np.concatenate((pixels, np.empty_like(pixels)))
                normals_px = np.concatenate((normals_px, np.empty_like(normals_px)))
                depths = np.concatenate((depths, np.empty_like(depths)))
                owners = np.concatenate((owners, np.empty_like(owners)))
            for k in range(3):
                points[found, k] = a[k] + t * (b[k] - a[k])
                tangents[found, k] = (b[k] - a[k]) / size
            pixels[found, 0] = u
            pixels[found, 1] = v
            normals_px[found, 0] = -dv / length
            normals_px[found, 1] = du / length
            depths[found] = z
            owners[found] = c
            found += 1
    return points[:found], tangents[:found], pixels[:found], normals_px[:found], depths[:found], owners[:found]


@kernel
def _own_samples(  # type: ignore[no-untyped-def]
    pixels, normals_px, depths, owners, ids, depth, tolerance_mm, shared_px, shared_cos, occluder_px
):  # fmt: skip
    """(N,) False for samples beside a parallel one of another component, or beside something in front of them."""
    height, width = ids.shape
    grid = np.full((height, width), -1, dtype=np.int32)
    following = np.full(pixels.shape[0], -1, dtype=np.int32)
    for i in range(pixels.shape[0]):
        x, y = int(np.round(pixels[i, 0])), int(np.round(pixels[i, 1]))
        following[i] = grid[y, x]
        grid[y, x] = i
    own = np.ones(pixels.shape[0], dtype=np.bool_)
    reach = max(int(np.ceil(shared_px)), occluder_px)
    for i in range(pixels.shape[0]):
        x0, y0 = int(np.round(pixels[i, 0])), int(np.round(pixels[i, 1]))
        for y in range(max(0, y0 - reach), min(height, y0 + reach + 1)):
            for x in range(max(0, x0 - reach), min(width, x0 + reach + 1)):
                in_front = ids[y, x] >= 0 and ids[y, x] != owners[i] and depth[y, x] < depths[i] - tolerance_mm
                if in_front and max(abs(x - x0), abs(y - y0)) <= occluder_px:
                    own[i] = False
                j = grid[y, x]
                while j >= 0:
                    if owners[j] != owners[i]:
                        apart = (pixels[j, 0] - pixels[i, 0]) ** 2 + (pixels[j, 1] - pixels[i, 1]) ** 2
                        along = normals_px[i, 0] * normals_px[j, 0] + normals_px[i, 1] * normals_px[j, 1]
                        if apart < shared_px * shared_px and abs(along) > shared_cos:
                            own[i] = False
                    j = following[j]
    return own


@kernel(fastmath=True)
def _thin_edges(slopes, weakest, edges, strength, directions):  # type: ignore[no-untyped-def]
    """Thin edges by the slope of the strongest channel (Canny, PAMI 1986).

    Args:
        slopes: (6,H,W) int16 Sobel's slopes to the right and down of each channel, eighths of a grey level per px.
        weakest: edge, grey levels per px.
        edges: (3,H,W) float32, becomes the slope, its part to the right and its part down.
        strength: (H,W) uint8, becomes the slope of edges in half grey levels per px, 0 = no edge.
        directions: (2,H,W) int8, becomes 127 times the unit vector along the slope.
    """
    height, width = strength.shape
    for y in range(height):
        for x in range(width):
            du, dv = np.float32(slopes[0, y, x]), np.float32(slopes[1, y, x])
            eu, ev = np.float32(slopes[2, y, x]), np.float32(slopes[3, y, x])
            fu, fv = np.float32(slopes[4, y, x]), np.float32(slopes[5, y, x])
            best, second, third = du * du + dv * dv, eu * eu + ev * ev, fu * fu + fv * fv
            if second > best:
                best, du, dv = second, eu, ev
            if third > best:
                best, du, dv = third, fu, fv
            edges[0, y, x] = np.sqrt(best)
            edges[1, y, x] = du
            edges[2, y, x] = dv
    strength[:] = 0
    size = edges[0]
    least = np.float32(8.0 * weakest)
    # Without branches, on rows that begin where the neighbours do: compiled to vector instructions, ten times faster.
    for y in range(2, height - 2):
        up_left, up, up_right = size[y - 1, 1:], size[y - 1, 2:], size[y - 1, 3:]
        left, here, right = size[y, 1:], size[y, 2:], size[y, 3:]
        down_left, down, down_right = size[y + 1, 1:], size[y + 1, 2:], size[y + 1, 3:]
        along_u, along_v, found = edges[1, y, 2:], edges[2, y, 2:], strength[y, 2:]
        direction_u, direction_v = directions[0, y, 2:], directions[1, y, 2:]
        for x in range(width - 4):
            a, b, c, d = up_left[x], up[x], up_right[x], left[x]
            e, f, g, h = right[x], down_left[x], down[x], down_right[x]
            m, du, dv = here[x], along_u[x], along_v[x]
            size_u, size_v = abs(du), abs(dv)
            is_falling, is_flat = du * dv > 0, size_u > size_v
            large, small = max(size_u, size_v), min(size_u, size_v)
            # The neighbours across the edge, between two pixels each.
            ahead = (h if is_falling else (c if is_flat else f)) * small + (e if is_flat else g) * (large - small)
            behind = (a if is_falling else (f if is_flat else c)) * small + (d if is_flat else b) * (large - small)
            is_edge = (m * large >= ahead) & (m * large > behind) & (m >= least)
            value = min(np.float32(255.0), np.float32(0.25) * m)
            found[x] = np.uint8(np.int32(value if is_edge else np.float32(0.0)))
            unit = np.float32(127.0) / max(m, np.float32(1.0))
            direction_u[x] = np.int8(np.int32(du * unit))
            direction_v[x] = np.int8(np.int32(dv * unit))


@kernel
def _mark_owners(pixels, depths, component, owners):  # type: ignore[no-untyped-def]
    """Set ``owners`` (H,W) int16 to the component whose edges pass within two pixels; -1 none, -2 several."""
    height, width = owners.shape
    owners[:] = -1
    for i in range(pixels.shape[0]):
        if depths[i] <= 0:
            continue
        x0, y0 = int(np.round(pixels[i, 0])), int(np.round(pixels[i, 1]))
        for y in range(max(0, y0 - 2), min(height, y0 + 3)):
            for x in range(max(0, x0 - 2), min(width, x0 + 3)):
                if owners[y, x] == -1:
                    owners[y, x] = component[i]
                elif owners[y, x] != component[i]:
                    owners[y, x] = -2


@kernel
def _strength_at(directions, strength, owners, c, places, normal, dx, dy):  # type: ignore[no-untyped-def]
    """Strongest edge within 25° of a direction at three places (3,2), shifted; others' edges do not count.

    ``normal`` (2,) is in 127ths. Without branches: what an edge is like cannot be foreseen.
    """
    height, width = strength.shape
    best = np.int64(0)
    for t in range(3):
        x, y = places[t, 0] + dx, places[t, 1] + dy
        if x < 0 or y < 0 or x >= width or y >= height:
            continue
        owner = owners[y, x]
        along = abs(directions[0, y, x] * normal[0] + directions[1, y, x] * normal[1])
        counts = (along > 14600) & ((owner < 0) | (owner == c))
        best = max(best, np.int64(strength[y, x]) * counts)
    return best


@kernel
def _best_shift(  # type: ignore[no-untyped-def]
    directions, strength, owners, c, places, along, count, worth, shifts, costs, hit
):  # fmt: skip
    """Share of ``count`` points on edges at the shift with the strongest edges; sets which points in ``hit``."""
    best = -1e9
    best_shift = 0
    share = 0.0
    for s in range(shifts.shape[0]):
        total = -costs[s] * count
        hits = 0
        for k in range(count):
            e = _strength_at(directions, strength, owners, c, places[k], along[k], shifts[s, 0], shifts[s, 1])
            hits += e > 0
            total += worth[e]
            if total + (count - 1 - k) < best:
                break
        if total > best:
            best, best_shift, share = total, s, hits / count
    dx, dy = shifts[best_shift, 0], shifts[best_shift, 1]
    for k in range(count):
        hit[k] = _strength_at(directions, strength, owners, c, places[k], along[k], dx, dy) > 0
    return share


@kernel
def _contrast(image, pixels, normals, depths, sides, is_own, first, last, reach_px):  # type: ignore[no-untyped-def]
    """Mean over runs of 10 outline points of how many deviations the colours change across; -1 without runs."""
    height, width = image.shape[:2]
    total = 0.0
    runs = 0
    i = first
    while i < last:
        j = i
        n = 0
        change = np.zeros(3)
        square = np.zeros(3)
        while (
            j < last
            and j - i < 10
            and sides[j, 0] == sides[i, 0]
            and sides[j, 1] == sides[i, 1]
            and depths[j] > 0
            and (pixels[j, 0] - pixels[i, 0]) ** 2 + (pixels[j, 1] - pixels[i, 1]) ** 2 < 144.0
        ):
            u, v, nu, nv = pixels[j, 0] + 0.5, pixels[j, 1] + 0.5, normals[j, 0] * reach_px, normals[j, 1] * reach_px
            xa, ya, xb, yb = int(u - nu), int(v - nv), int(u + nu), int(v + nv)
            if is_own[j] and min(xa, xb) >= 0 and min(ya, yb) >= 0 and max(xa, xb) < width and max(ya, yb) < height:
                n += 1
                for q in range(3):
                    d = float(image[yb, xb, q]) - float(image[ya, xa, q])
                    change[q] += d
                    square[q] += d * d
            j += 1
        if n >= 5 and sides[i, 0] != sides[i, 1]:
            runs += 1
            largest = 0.0
            for q in range(3):
                mean = change[q] / n
                deviation = np.sqrt(max(square[q] / n - mean * mean, 1.0) / n)
                largest = max(largest, abs(mean) / (deviation + 0.5))
            total += min(largest, 10.0)
        i = max(j, i + 1)
    return total / runs if runs > 0 else -1.0


@kernel
def _surroundings(pixels, chosen, sizes, hit, c, wanted, least):  # type: ignore[no-untyped-def]
    """Share of other components' points that is borne out, of those nearest to its points that are not; 1 if few."""
    low_u, high_u, low_v, high_v = 1e9, -1e9, 1e9, -1e9
    for k in range(sizes[c]):
        if not hit[c, k]:
            i = chosen[c, k]
            low_u, high_u = min(low_u, pixels[i, 0]), max(high_u, pixels[i, 0])
            low_v, high_v = min(low_v, pixels[i, 1]), max(high_v, pixels[i, 1])
    reach = 16.0
    hits = 0
    tried = 0
    while reach < 130.0:
        hits = 0
        tried = 0
        for o in range(sizes.shape[0]):
            if o == c:
                continue
            for k in range(sizes[o]):
                u, v = pixels[chosen[o, k], 0], pixels[chosen[o, k], 1]
                if u < low_u - reach or u > high_u + reach or v < low_v - reach or v > high_v + reach:
                    continue
                for q in range(sizes[c]):
                    j = chosen[c, q]
                    if not hit[c, q] and (pixels[j, 0] - u) ** 2 + (pixels[j, 1] - v) ** 2 < reach * reach:
                        tried += 1
                        hits += hit[o, k]
                        break
        if tried >= wanted:
            break
        reach *= 1.5
    return hits / tried if tried >= least else 1.0


@kernel
def measure_components(  # type: ignore[no-untyped-def]
    image, slopes, edges, strength, directions, owners, points, tangents, component, sides, is_own, starts,
    cam_from_body, intrinsics, step_mm, near, near_costs, far, weakest, most_points, least_points, seen_well,
    usual_elsewhere, colour_px, around, least_around
):  # fmt: skip
    """What a picture shows of each component.

    Args:
        image: (H,W,3) uint8, smoothed; slopes: (6,H,W) int16 of it, see `_thin_edges`.
        edges, strength, directions, owners: (3,H,W) float32, (H,W) uint8, (2,H,W) int8 and (H,W) int16 to work in.
        points, tangents, component, sides, is_own, starts: of a `ComponentSheet`.
        cam_from_body, intrinsics: (4,4) and (10,) of the picture.
        step_mm: length over which directions are projected.
        near, near_costs: (S,2) int shifts in px that leave a component where it is, and what each must gain.
        far: (T,2) int shifts in px to other places.

    Returns:
        (C,6): share of its points borne out, -1 where it does not show; the best share elsewhere; contrast; share of
        the surroundings borne out; share of all other components borne out; points by their weakest direction.
    """
    height, width = image.shape[:2]
    count = starts.shape[0] - 1
    pixels, normals, depths = project_lines(points, tangents, True, cam_from_body, intrinsics, step_mm)
    _thin_edges(slopes, weakest, edges, strength, directions)
    _mark_owners(pixels, depths, component, owners)
    found = np.full((count, 6), -1.0)
    chosen = np.empty((count, most_points), dtype=np.int64)
    sizes = np.zeros(count, dtype=np.int64)
    hit = np.zeros((count, most_points), dtype=np.bool_)
    elsewhere = np.zeros(most_points, dtype=np.bool_)
    usable = np.empty(pixels.shape[0], dtype=np.int64)
    places = np.empty((most_points, 3, 2), dtype=np.int64)
    along = np.empty((most_points, 2), dtype=np.int64)
    worth = np.arange(256) / (np.arange(256) + 20.0)
    no_costs = np.zeros(far.shape[0])
    all_hits = 0.0
    all_points = 0
    for c in range(count):
        own = 0
        inside = 0
        xx = 0.0
        yy = 0.0
        xy = 0.0
        for i in range(starts[c], starts[c + 1]):
            if not is_own[i]:
                continue
            own += 1
            if depths[i] > 0 and 3 < pixels[i, 0] < width - 4 and 3 < pixels[i, 1] < height - 4:
                usable[inside] = i
                inside += 1
                xx += normals[i, 0] ** 2
                yy += normals[i, 1] ** 2
                xy += normals[i, 0] * normals[i, 1]
        if inside < least_points or inside < 0.8 * own:
            continue
        kept = min(inside, most_points)
        for k in range(kept):
            i = usable[int((k + 0.5) * inside / kept)]
            chosen[c, k] = i
            along[k, 0] = int(np.round(127.0 * normals[i, 0]))
            along[k, 1] = int(np.round(127.0 * normals[i, 1]))
            for t in range(3):
                places[k, t, 0] = int(pixels[i, 0] + (t - 1) * normals[i, 0] + 0.5)
                places[k, t, 1] = int(pixels[i, 1] + (t - 1) * normals[i, 1] + 0.5)
        sizes[c] = kept
        here = _best_shift(directions, strength, owners, c, places, along, kept, worth, near, near_costs, hit[c])
        found[c, 0] = here
        found[c, 1] = usual_elsewhere
        if here < seen_well:
            found[c, 1] = _best_shift(
                directions, strength, owners, c, places, along, kept, worth, far, no_costs, elsewhere
            )
        first, last = starts[c], starts[c + 1]
        found[c, 2] = _contrast(image, pixels, normals, depths, sides, is_own, first, last, colour_px)
        found[c, 5] = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        all_points += kept
        all_hits += here * kept
    for c in range(count):
        if sizes[c] == 0:
            continue
        found[c, 3] = _surroundings(pixels, chosen, sizes, hit, c, around, least_around)
        others = all_points - sizes[c]
        found[c, 4] = (all_hits - found[c, 0] * sizes[c]) / others if others > 0 else 1.0
    return found


def said_by_edges(found: Array) -> Array:
    """Log-likelihood ratios (C,) of "not where expected" to "as expected" by what was measured (C,6)."""
    borne_out, elsewhere, contrast, _, _, spread = found.T
    constant, per_share, per_lead, per_contrast = MODEL
    ratio = constant + per_share * borne_out + per_lead * (borne_out - elsewhere)
    ratio += per_contrast * np.where(contrast < 0.0, USUAL_CONTRAST, np.minimum(contrast, MOST_CONTRAST))
    return np.asarray(ratio * np.maximum(spread, 0.0) / (np.maximum(spread, 0.0) + HALF_LAMBDA))


def together(by_edges: Array, by_network: Array, is_open: Array | float = 1.0) -> Array:
    """Log-likelihood ratios (C,) by edges and network, NaN where this says nothing; see `BOTH`.

    ``is_open`` is 0 where nothing is borne out around a component, or in the picture, and 1 where all is: where these
    are not seen either, something hides it, or the picture is blurred.
    """
    constant, per_edges, per_against, per_for = BOTH
    alone = np.where(by_edges > 0.0, EDGES_ALONE * by_edges * is_open, by_edges)
    edges = np.where(by_edges > 0.0, np.minimum(by_edges, MOST_SAID) * is_open, by_edges)
    against = np.maximum(np.minimum(by_network, MOST_SAID) - HIDDEN_DOUBT * (1.0 - np.asarray(is_open)), 0.0)
    both = constant + per_edges * edges + per_against * against + per_for * np.minimum(by_network, 0.0)
    return np.asarray(np.where(np.isnan(by_network), alone, both))


class AssemblyMonitor:
    """Watches whether the components of one part are where the CAD has them, for one camera.

    Args:
        views: guide views; their directions and camera are used.
        model: the same model.
        camera: of the pictures.
    """

    def __init__(self, views: GuideViewSet, camera: Camera, model: Model) -> None:
        self.views, self.model, self.camera = views, model, camera
        self._renderer = ZBufferRenderer(model, views.camera)
        self._edges = mesh_edges(model, views.options.crease_angle_deg)
        self._model_from_body = rigid(np.eye(3), views.center_in_model)
        self._surface = views.surface
        self._network, self._line_network = ComponentNetwork(), EdgeNet()
        self._elsewhere = ElsewhereSearch(other_places(model), self._surface, views.diameter_mm, self._network)
        low, high = model.bounds_in_model
        self._corners_in_model = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)])
        self._sheets: dict[int, ComponentSheet] = {}
        self._buffers: dict[str, NDArray[Any]] = {}
        self.reset()

    @property
    def mismatches(self) -> tuple[str, ...]:
        """What is not as the CAD says, one message a component."""
        return self._messages(self._is_named)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of components that are to be looked at again before the part can be called right."""
        names = self.views.component_names
        return tuple(names[index] for index in np.flatnonzero((self._evidence > CLEARED) & ~self._is_named))

    @property
    def unverified(self) -> tuple[str, ...]:
        """Names of components that no look so far has shown surely at their place; none of a part of one component."""
        if len(self.model.components) < 2:
            return ()
        return tuple(self.views.component_names[index] for index in np.flatnonzero(~self._is_seen))

    def reset(self) -> None:
        """Forget what was seen: another part may be in view."""
        count = len(self.views.component_names)
        self._evidence = np.zeros(count)
        self._is_named, self._is_seen = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        self._looks = 0
        self._rested = 0
        self._has_suspects, self._was_shown = False, np.zeros(count, dtype=bool)
        self._directions = np.zeros((0, 3))
        self._looks_from, self._said_from = np.zeros((0, count)), np.zeros((0, count))

    def update(self, image: NDArray[np.uint8], cam_from_model: Array) -> None:
        """Take in a frame with a good pose; only frames that may tell something new are looked at."""
        self._rested += 1
        if len(self.model.components) < 2 or not self._is_due(cam_from_model):
            return
        look = self.look(image, cam_from_model, self._looked_for())
        self._looks += 1
        self._rested = 0
        self._has_suspects, self._was_shown = bool(look.is_suspect.any()), look.is_shown
        told = self._told(cam_from_model, np.minimum(look.against, LARGEST_NEWS))
        self._evidence = np.clip((1.0 - FORGETTING) * self._evidence + told, -BOUND, BOUND)
        self._is_seen = self._evidence < np.where(self._is_seen, CLEARED, SEEN)
        if self._looks >= EAGER_LOOKS:
            self._is_named = self._evidence > np.where(self._is_named, CLEARED, NAMED)

    def _looked_for(self) -> NDArray[np.bool_]:
        """(C,) which components are looked for elsewhere, too: of those not surely seen all at first, then in turn."""
        is_open = self._evidence > SURE
        if self._looks < EAGER_LOOKS or not is_open.any():
            return is_open
        in_turn = np.flatnonzero(is_open)
        return np.asarray(np.arange(len(is_open)) == in_turn[self._looks % len(in_turn)])

    def _is_due(self, cam_from_model: Array) -> bool:
        """Whether a frame may tell something new; the more is open, the sooner the next look."""
        if self._looks < EAGER_LOOKS:
            return True
        if self._rested < SUSPICIOUS_FRAMES:
            return False
        highest = float(self._evidence.max())
        waits = (SUSPICIOUS_FRAMES, OPEN_FRAMES, REST_FRAMES, REST_FRAMES)
        step = 0 if self._has_suspects or highest > CLEARED else 1 if highest > SURE else 2
        if step == 1 and self._shows_new(cam_from_model):
            step = 0
        if self._rested < waits[step]:
            return False
        nearest = self._nearest_seen(cam_from_model)
        is_fresh = nearest < 0 or (step == 0 and self._looks_from[nearest].max() < FRESH_LOOKS)
        return is_fresh or self._rested >= waits[step + 1]

    def _shows_new(self, cam_from_model: Array) -> bool:
        """Whether this direction shows a component that has not been seen and that the last look could not show."""
        sheet = self._sheet(cam_from_model)
        points = np.bincount(sheet.component[sheet.is_own], minlength=len(self._was_shown))
        return bool(np.any((self._evidence > SURE) & ~self._was_shown & (points >= LEAST_POINTS)))

    def mismatches_in(self, image: NDArray[np.uint8], cam_from_model: Array) -> tuple[str, ...]:
        """Mismatches that one picture alone bears out; what was seen before does not count, nor is it changed."""
        if len(self.model.components) < 2:
            return ()
        return self._messages(self.look(image, cam_from_model).against > SINGLE)

    def look(self, image: NDArray[np.uint8], cam_from_model: Array, is_open: NDArray[np.bool_] | None = None) -> Look:
        """What a picture says of the components at a pose.

        Args:
            image: (H,W,3) uint8 RGB of the camera's size.
            cam_from_model: (4,4) mm, right to a pixel or two.
            is_open: (C,) which components have not been seen surely yet and are looked for elsewhere, too; None: all.
        """
        found = self._measured(image, cam_from_model)
        borne_out, elsewhere, contrast, around, others, _ = found.T
        is_shown = borne_out >= 0.0
        is_open = np.ones(len(is_shown), dtype=bool) if is_open is None else is_open
        by_edges = np.where(is_shown, said_by_edges(found), 0.0)
        clear = np.clip((np.minimum(around, others) - HIDDEN_SHARE) / (CLEAR_SHARE - HIDDEN_SHARE), 0.0, 1.0)
        clear = np.where(is_shown, clear, 1.0)
        is_asked = is_shown & (by_edges > SETTLED)
        by_network, moved = self._seen_by_network(image, cam_from_model, is_asked, is_open, clear)
        moved += ELSEWHERE_EDGES * np.minimum(by_edges, 0.0)
        moved = clear * np.maximum(moved, 0.0) + np.minimum(moved, 0.0)
        is_suspect = is_shown & (together(by_edges, by_network) > SUSPECT) | (moved > SUSPECT)
        more_suspects = max(0, int(np.count_nonzero(is_suspect)) - SUSPECTS)
        ratio = np.maximum(np.where(is_shown, together(by_edges, by_network, clear), 0.0), moved)
        ratio = np.where(ratio > 0.0, ratio * 0.5**more_suspects, ratio)
        against = np.clip(ratio, -LARGEST_RATIO, LARGEST_RATIO)
        return Look(against, is_suspect, is_shown, borne_out, elsewhere, contrast, around)

    def _seen_by_network(
        self,
        image: NDArray[np.uint8],
        cam_from_model: Array,
        is_asked: NDArray[np.bool_],
        is_open: NDArray[np.bool_],
        clear: Array,
    ) -> tuple[Array, Array]:
        """What the network says of components (C,), and for their standing elsewhere (C,).

        The first of those that are asked for, NaN of the others and those that are too small; the second of those that
        are open, -inf where it says nothing. What it says against a component counts as ``clear`` as its place is.
        """
        at_home, moved = np.full(len(is_asked), np.nan), np.full(len(is_asked), -np.inf)
        if not (is_asked | is_open).any():
            return at_home, moved
        window, intrinsics, _ = self._window(image, cam_from_model)
        cam_from_body = cam_from_model @ self._model_from_body
        answers = self._line_network.predict(window)
        looks = component_looks(
            window, answers, intrinsics, self._surface, self.views.diameter_mm, cam_from_body,
            np.flatnonzero(is_asked | is_open).tolist(),
        )  # fmt: skip
        # What is asked only to know whether to look elsewhere need not be told that well.
        for is_exact in (True, False):
            some = [look for look in looks if is_asked[look.index] == is_exact]
            at_home[[look.index for look in some]] = self._network.ratios(some, in_mirrors=is_exact)
        if is_open.any():
            ratios = np.where(at_home > 0.0, clear * at_home, at_home)
            moved = self._elsewhere.against(window, answers, intrinsics, cam_from_body, ratios, is_open)
        return np.where(is_asked, at_home, np.nan), moved

    def _window(self, image: NDArray[np.uint8], cam_from_model: Array) -> tuple[NDArray[np.uint8], Array, float]:
        """The picture around the part (H,W,3), perhaps shrunk, its intrinsics (10,), and px per mm in it."""
        camera, diameter_mm = self.camera, self.views.diameter_mm
        cam_from_body = cam_from_model @ self._model_from_body
        scale = camera.fx / max(float(cam_from_body[2, 3]), 1.0)
        shrink = max(1, round(diameter_mm * scale / LARGEST_PX))
        size = np.array([camera.width, camera.height])
        corners = np.nan_to_num(camera.project(apply(cam_from_model, self._corners_in_model)))
        margin = SEARCHED_PX * shrink
        low = np.clip(np.floor(corners.min(axis=0) - margin), 0, size - 8 * shrink).astype(int)
        small = (np.clip(np.ceil(corners.max(axis=0) + margin), low + 8 * shrink, size).astype(int) - low) // shrink
        high = low + small * shrink
        window = image[low[1] : high[1], low[0] : high[0]]
        if shrink > 1:
            window = np.asarray(cv2.resize(window, (int(small[0]), int(small[1])), interpolation=cv2.INTER_AREA))
        seen_by = camera.cropped(*low.tolist(), *(high - low).tolist()).scaled(*small.tolist())
        return window, intrinsics_of(seen_by), scale / shrink

    def _measured(self, image: NDArray[np.uint8], cam_from_model: Array) -> Array:
        """(C,6), see `measure_components`."""
        diameter_mm, cam_from_body = self.views.diameter_mm, cam_from_model @ self._model_from_body
        window, intrinsics, scale = self._window(image, cam_from_model)
        allowed = min(DISPLACED_MM, DISPLACED_SHARE * diameter_mm) * scale + POSE_PX
        searched = min(SEARCHED_MM * scale, SEARCHED_SHARE * diameter_mm * scale, SEARCHED_PX)
        near, far = _disc(0.0, allowed, 1), _disc(allowed + 2.0, max(searched, allowed + 6.0), 3)
        sheet = self._sheet(cam_from_model)
        shape = window.shape[:2]
        smooth = cv2.GaussianBlur(window, (3, 3), 0, dst=self._buffer("smooth", window.shape, np.uint8))
        slopes = self._buffer("slopes", (6, *shape), np.int16)
        for index, plane in enumerate(cv2.split(smooth)):
            cv2.spatialGradient(plane, dx=slopes[2 * index], dy=slopes[2 * index + 1])
        edges = self._buffer("edges", (3, *shape), np.float32)
        strength, owners = self._buffer("strength", shape, np.uint8), self._buffer("owners", shape, np.int16)
        directions = self._buffer("directions", (2, *shape), np.int8)
        return np.asarray(
            measure_components(
                smooth, slopes, edges, strength, directions, owners, sheet.points_in_body, sheet.tangents,
                sheet.component, sheet.sides, sheet.is_own, sheet.starts, cam_from_body, intrinsics, 0.01 * diameter_mm,
                near, SHIFT_COST * np.sum(near**2, axis=1) / allowed**2, far, WEAKEST_STEP, POINTS, LEAST_POINTS,
                SEEN_WELL, USUAL_ELSEWHERE, COLOUR_PX, SURROUNDINGS, LEAST_SURROUNDINGS,
            )
        )  # fmt: skip

    def _buffer(self, name: str, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        """An array kept from look to look: fresh memory costs more than what is done in it."""
        size = int(np.prod(shape))
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = np.empty(size, dtype=dtype)
        return self._buffers[name][:size].reshape(shape)

    def _sheet(self, cam_from_model: Array) -> ComponentSheet:
        """The edges of the guide view whose direction is nearest, made when first needed."""
        index = self.views.nearest_index(cam_from_model)
        if index not in self._sheets:
            if len(self._sheets) >= KEPT_SHEETS:
                del self._sheets[next(iter(self._sheets))]
            self._sheets[index] = self._make_sheet(self.views.poses[index])
        return self._sheets[index]

    def _make_sheet(self, cam_from_model: Array) -> ComponentSheet:
        camera, edges = self.views.camera, self._edges
        rendering = self._renderer.render(cam_from_model)
        ids, depth = rendering.component_ids, rendering.depth_mm
        # Two pixels' worth of a surface seen at 45 degrees.
        tolerance_mm = 3.0 * float(apply(cam_from_model, self.views.center_in_model)[2]) / camera.fx
        points, tangents, pixels, normals_px, depths, owners = _sample_edges(
            edges.vertices_in_model, edges.ends, edges.faces, edges.is_sharp, edges.face_normals, edges.component,
            cam_from_model, camera.fx, camera.cx, ids, depth, tolerance_mm,
        )  # fmt: skip
        order = np.argsort(owners, kind="stable")
        own = _own_samples(
            pixels, normals_px, depths, owners, ids, depth, tolerance_mm, SHARED_PX, SHARED_COS, OCCLUDER_PX
        )
        beside = [np.round(pixels + sign * SIDE_PX * normals_px).astype(np.intp) for sign in (-1, 1)]
        beside = [np.clip(place, 0, [camera.width - 1, camera.height - 1]) for place in beside]
        return ComponentSheet(
            points_in_body=(points - self.views.center_in_model)[order].astype(np.float32),
            tangents=tangents[order].astype(np.float32),
            component=owners[order],
            sides=np.stack([ids[place[:, 1], place[:, 0]] for place in beside], axis=1)[order],
            is_own=own[order],
            starts=np.searchsorted(owners[order], np.arange(len(self.model.components) + 1)).astype(np.int64),
        )

    def _direction(self, cam_from_model: Array) -> Array:
        """(3,) unit vector from the part's centre to the camera."""
        offset = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3] - self.views.center_in_model
        return np.asarray(offset / np.linalg.norm(offset), dtype=np.float64)

    def _nearest_seen(self, cam_from_model: Array) -> int:
        """Index of the direction that was looked from before, or -1 when none is near."""
        cosines = self._directions @ self._direction(cam_from_model)
        if len(cosines) == 0 or cosines.max() < np.cos(np.deg2rad(NEW_DIRECTION_DEG)):
            return -1
        return int(np.argmax(cosines))

    def _told(self, cam_from_model: Array, against: Array) -> Array:
        """(C,) by how much a look changes the evidence: what its direction says on the average, less what it had said.

        Looks from one direction see the same, but for noise and blur: they are averaged, and many say little more than
        one. What is said for a component that is named counts less, unless it takes back what its direction had said.
        """
        nearest = self._nearest_seen(cam_from_model)
        if nearest < 0:
            self._directions = np.concatenate([self._directions[-63:], self._direction(cam_from_model)[None]])
            none = np.zeros((1, len(against)))
            self._looks_from = np.concatenate([self._looks_from[-63:], none])
            self._said_from = np.concatenate([self._said_from[-63:], none])
        looks, said = self._looks_from[nearest], self._said_from[nearest]
        clearing = np.where(self._is_named, CLEARING, 1.0)
        before = _worth_of(looks, said, clearing)
        looks += against != 0.0
        said += against
        return _worth_of(looks, said, clearing) - before

    def _messages(self, is_wrong: NDArray[np.bool_]) -> tuple[str, ...]:
        names = self.views.component_names
        return tuple(f"mismatch: {names[index]} not seen where expected" for index in np.flatnonzero(is_wrong))


def _worth_of(looks: Array, said: Array, clearing: Array) -> Array:
    """What looks from one direction say together (C,), by their number and the sum of what they said.

    What speaks for a component counts by ``clearing``.
    """
    count = (1.0 - REPEATED_NEWS**looks) / (1.0 - REPEATED_NEWS) + LEAST_NEWS * np.maximum(looks - 4.0, 0.0)
    return np.asarray(count * np.where(said < 0.0, clearing, 1.0) * said / np.maximum(looks, 1.0))


def _disc(inner_px: float, outer_px: float, step: int) -> NDArray[np.int64]:
    """(S,2) points of a grid between two radii."""
    reach = step * int(outer_px // step)
    axis = np.arange(-reach, reach + 1, step)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    radius = np.linalg.norm(points, axis=1)
    return np.ascontiguousarray(points[(radius >= inner_px) & (radius <= outer_px)], dtype=np.int64)
