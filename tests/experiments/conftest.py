"""Whole runs that several files look at: the first of all workers makes them."""

import os

import pytest
import runs


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """A folder that the workers share, as long as the tests run."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"


@pytest.fixture(scope="session")
def explored_once(shared):
    """A function of seeds: their exploration run, which is to be read, not written."""
    return lambda *seeds: runs.explored_once(shared, *seeds)


@pytest.fixture(scope="session")
def performed_once(shared):
    """The folder of seed 0 after a zero-shot with a refit; to be read, too."""
    return runs.performed_once(shared)


@pytest.fixture(scope="session")
def explored_copy(explored_once, tmp_path_factory):
    """A function of seeds: the folder of their exploration run, to be written."""
    return lambda *seeds: runs.copied(
        explored_once(*seeds).folder, tmp_path_factory.mktemp("copy")
    )
