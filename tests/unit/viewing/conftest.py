import pytest

from tests.conftest import make_heap
from tests.cycle_files import make_recording, write_cycle


@pytest.fixture
def recording(heap, shapes):
    return make_recording(heap, shapes)


@pytest.fixture(scope="session")
def session_recording(shapes):
    return make_recording(make_heap(), shapes)


@pytest.fixture
def folder(tmp_path, plan, recording):
    return write_cycle(tmp_path, plan, recording)
