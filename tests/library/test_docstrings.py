"""What `help()` shows: the letters of shapes, and every field of every record."""

import dataclasses
import re

import pytest

import jaxpets
from jaxpets import coordinates, formulas, models

MODULES = [
    jaxpets,
    coordinates,
    jaxpets.datasets,
    formulas,
    models,
    jaxpets.optimizers,
    jaxpets.rewards,
    jaxpets.typing,
]


def fields_of(thing):
    """Names of the fields of a record; empty for whatever is none."""
    if not isinstance(thing, type):
        return []
    if dataclasses.is_dataclass(thing):
        return [field.name for field in dataclasses.fields(thing)]
    return list(getattr(thing, "_fields", ()))


PUBLIC = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in MODULES
    for name in module.__all__
}
RECORDS = {name: thing for name, thing in PUBLIC.items() if fields_of(thing)}


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_documents_its_fields_in_their_order(name):
    doc = RECORDS[name].__doc__ or ""
    _, found, attributes = doc.partition("Attributes:\n")
    assert found, f"{name} has no section Attributes"
    documented = re.findall(r"^ +(\w+): ", attributes, re.MULTILINE)
    assert documented == fields_of(RECORDS[name])


def test_there_are_records_to_look_at():
    names = {name.rpartition(".")[2] for name in RECORDS}
    assert {"PlanOutput", "FitMetrics", "CEMState", "Dataset", "FitConfig"} <= names


@pytest.mark.parametrize("letter", "NHEPBDFATCS")
def test_the_front_page_explains_every_letter(letter):
    assert re.search(rf"^  {letter}  \w", jaxpets.__doc__, re.MULTILINE)


@pytest.mark.parametrize("name", PUBLIC)
def test_everything_public_has_a_docstring_of_its_own(name):
    thing = PUBLIC[name]
    if callable(thing):
        assert thing.__doc__ and "Alias for field" not in thing.__doc__


def test_the_front_page_is_short():
    assert len(jaxpets.__all__) <= 36
    assert jaxpets.__all__ == sorted(jaxpets.__all__, key=_order)


def _order(name):
    """Constants, classes, functions, as the linter sorts them."""
    return (not name.isupper(), not name[0].isupper(), name)
