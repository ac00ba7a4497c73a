"""Models of the DeepMind Control Suite, from the installed dm_control."""

import importlib.resources
from typing import Any
from xml.etree import ElementTree

from jaxpets.envs.extra import needs_extra

with needs_extra():
    import mujoco

_C: Any = mujoco  # its names are made at import, where pyright does not see them
# Of quadruped, where its tasks of moving leave them out.
_SCENERY = ("wall_px", "wall_py", "wall_nx", "wall_ny", "ball", "target", "terrain")


def load_model(name: str) -> Any:
    """Returns a domain's compiled MuJoCo model, as dm_control's tasks have it.

    Energy is not computed: nothing reads it, and MJX cannot. dm_control itself is not
    imported: its files are read.

    Args:
      name: of a file of `dm_control/suite`, without its suffix.

    Raises:
      ImportError: without dm_control; it names the extra.
    """
    with needs_extra("dmc"):
        suite = importlib.resources.files("dm_control") / "suite"
    root = ElementTree.fromstring((suite / f"{name}.xml").read_text())
    if name == "quadruped":
        _clear(root)
    files = [include.attrib["file"] for include in root.iter("include")]
    assets = {file: (suite / file).read_bytes() for file in files}
    # The attribute is about to leave MuJoCo; the function does the same.
    compiler = root.find("compiler")
    mass = None if compiler is None else compiler.attrib.pop("settotalmass", None)
    xml = ElementTree.tostring(root, "unicode")
    model = _C.MjModel.from_xml_string(xml, assets)
    if mass is not None:
        _C.mj_setTotalmass(model, float(mass))
        _C.mj_setConst(model, _C.MjData(model))
    model.opt.enableflags &= ~int(_C.mjtEnableBit.mjENBL_ENERGY)
    return model


def _clear(root: ElementTree.Element) -> None:
    """Leaves of quadruped's world what its tasks of moving have."""
    for parent in root.iter():
        for child in list(parent):
            is_scenery = child.tag in ("geom", "body", "site") and (
                child.get("name") in _SCENERY
            )
            if is_scenery or child.tag == "rangefinder":
                parent.remove(child)
    floor = root.find(".//geom[@name='floor']")
    assert floor is not None
    floor.set("size", "100 100 .5")  # as `run` has it; drawn only
