"""The tables [[steps]] of a part file: which components are mounted, and in which order."""

from __future__ import annotations

from collections.abc import Sequence

from arview.cad.model import Step
from arview.cad.part import unknown_component
from arview.cad.toml_table import TomlTable
from arview.errors import InputError


def read_steps(tables: Sequence[TomlTable], components: Sequence[str]) -> tuple[Step, ...]:
    """The steps of a part file, in its order.

    Args:
        tables: one for each step.
        components: names of those that are not ignored.

    Raises:
        InputError: an unknown key, a wrong type, an unknown component, one that two steps mount, a name that appears
            twice, or a step that must be done before and does not stand before.
    """
    steps: list[Step] = []
    for table in tables:
        table.take("mount")
        mount = table.texts("mount")
        for name in mount:
            if name not in components:
                raise InputError(f"{table.path}: [steps] {unknown_component(name, list(components))}")
            if name in (other for step in steps for other in step.mount) or mount.count(name) > 1:
                table.fail("mount", name, "components that are mounted once")
        earlier = [step.name for step in steps]
        name = table.line("name", ", ".join(mount))
        if name in earlier:
            table.fail("name", name, "a name that no other step has")
        after = (
            () if table.known("after") and table.content["after"] == [] else table.texts("after", tuple(earlier[-1:]))
        )
        for other in after:
            if other not in earlier:
                table.fail("after", other, f"names of steps above this one, of {', '.join(earlier) or 'none'}")
        table.finish()
        steps.append(Step(name, mount, after))
    return tuple(steps)
