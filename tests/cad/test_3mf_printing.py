"""3MF: what is there only for printing, and is no body."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from arview.cad.load import load_cad
from arview.errors import InputError
from helpers.cad_files import box, mesh_xml, write_3mf

PLATE, SLOT, BLOCK = box((0, 0, 0), (60, 40, 5)), box((20, 10, -1), (30, 30, 6)), box((0, 0, 0), (10, 10, 50))
SUPPORTS = "left out, because they are no bodies but supports, modifiers or the like: "
CUTTERS = "the slicer cuts these out, which is not done here; export the body that is cut: "


def with_config(path: Path, name: str, config: str) -> Path:
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(f"Metadata/{name}", f'<?xml version="1.0"?><config>{config}</config>')
    return path


def one_mesh(*boxes: tuple[np.ndarray, np.ndarray]) -> str:
    vertices = np.concatenate([points for points, _ in boxes])
    return mesh_xml(vertices, np.concatenate([faces + 8 * k for k, (_, faces) in enumerate(boxes)]))


def volume(first: int, name: str, kind: str, key: str = "volume_type") -> str:
    return (
        f'<volume firstid="{first}" lastid="{first + 11}"><metadata type="volume" key="name" value="{name}"/>'
        f'<metadata type="volume" key="{key}" value="{kind}"/></volume>'
    )


@pytest.mark.parametrize(
    ("kinds", "notes"),
    [
        (
            ("NegativeVolume", "ParameterModifier"),
            (f"{SUPPORTS}tall (parametermodifier)", f"{CUTTERS}slot (negativevolume)"),
        ),
        (
            ("SupportBlocker", "SupportEnforcer"),
            (f"{SUPPORTS}slot (supportblocker), tall (supportenforcer)",),
        ),
    ],
)
def test_volumes_of_a_mesh_that_are_no_bodies_are_left_out(
    kinds: tuple[str, str], notes: tuple[str, ...], tmp_path: Path
) -> None:
    # The body is between the others, so that numbers of triangles matter.
    path = write_3mf(
        tmp_path / "p.3mf", f'<object id="4">{one_mesh(SLOT, PLATE, BLOCK)}</object>', '<item objectid="4"/>'
    )
    volumes = volume(0, "slot", kinds[0]) + volume(12, "plate", "ModelPart") + volume(24, "tall", kinds[1])
    name = '<metadata type="object" key="name" value="cover"/>'
    cad = load_cad(with_config(path, "Slic3r_PE_model.config", f'<object id="4">{name}{volumes}</object>'))
    (component,) = cad.model.components
    assert component.name == "cover" and len(component.faces) == 12
    np.testing.assert_allclose(component.bounds_in_model, [[0, 0, 0], [60, 40, 5]])
    assert cad.notes == notes


def test_modifiers_of_older_slicers_are_left_out(tmp_path: Path) -> None:
    path = write_3mf(tmp_path / "p.3mf", f'<object id="1">{one_mesh(PLATE, BLOCK)}</object>', '<item objectid="1"/>')
    volumes = volume(0, "plate", "0", "modifier") + volume(12, "dense", "1", "modifier")
    cad = load_cad(with_config(path, "Slic3r_PE_model.config", f'<object id="1">{volumes}</object>'))
    np.testing.assert_allclose(cad.model.bounds_in_model, [[0, 0, 0], [60, 40, 5]])
    assert cad.notes == (f"{SUPPORTS}dense (modifier)",)


def test_components_that_are_no_bodies_are_left_out(tmp_path: Path) -> None:
    resources = "".join(
        f'<object id="{k}" type="{kind}">{mesh_xml(*mesh)}</object>'
        for k, kind, mesh in ((1, "model", PLATE), (2, "other", SLOT), (3, "model", BLOCK))
    )
    components = "".join(f'<component objectid="{k}"/>' for k in (1, 2, 3))
    resources += f'<object id="9"><components>{components}</components></object>'
    path = write_3mf(tmp_path / "p.3mf", resources, '<item objectid="9"/>')
    parts = "".join(
        f'<part id="{k}" subtype="{kind}"><metadata key="name" value="{name}"/></part>'
        for k, kind, name in ((1, "normal_part", "lid"), (2, "negative_part", "hole"), (3, "modifier_part", "dense"))
    )
    cad = load_cad(with_config(path, "model_settings.config", f'<object id="9">{parts}</object>'))
    assert [one.name for one in cad.model.components] == ["lid"]
    np.testing.assert_allclose(cad.model.bounds_in_model, [[0, 0, 0], [60, 40, 5]])
    assert cad.notes == (f"{SUPPORTS}dense (modifierpart)", f"{CUTTERS}hole (negativepart)")


@pytest.mark.parametrize("kind", ["support", "solidsupport", "other"])
def test_supports_are_left_out_and_named(kind: str, tmp_path: Path) -> None:
    resources = (
        f'<object id="1" name="plate">{mesh_xml(*PLATE)}</object>'
        f'<object id="2" type="{kind}" name="tree">{mesh_xml(*BLOCK)}</object>'
        '<object id="3"><components><component objectid="1"/><component objectid="2"/></components></object>'
    )
    cad = load_cad(write_3mf(tmp_path / "p.3mf", resources, '<item objectid="3"/><item objectid="2"/>'))
    assert [one.name for one in cad.model.components] == ["plate"]
    assert cad.notes == (f"{SUPPORTS}tree ({kind})",)
    path = write_3mf(tmp_path / "s.3mf", resources, '<item objectid="2"/>')
    with pytest.raises(InputError, match=rf"s\.3mf: left out, .*: tree \({kind}\)$"):
        load_cad(path)


def test_a_broken_configuration_is_refused_in_one_line(tmp_path: Path) -> None:
    path = write_3mf(tmp_path / "p.3mf", f'<object id="1">{mesh_xml(*PLATE)}</object>', '<item objectid="1"/>')
    with pytest.raises(InputError, match=r"p\.3mf: broken 3MF") as caught:
        load_cad(
            with_config(
                path,
                "Slic3r_PE_model.config",
                '<object id="1"><part id="1" firstid="x" subtype="negative_part"/></object>',
            )
        )
    assert "\n" not in str(caught.value)
