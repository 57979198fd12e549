import pytest

from drakerock.autonomy.model import LoaderModel
from tests.unit.autonomy.synthetic import make_data


@pytest.fixture(scope="session")
def loadings():
    return make_data()


@pytest.fixture(scope="session")
def model(loadings):
    return LoaderModel(loadings)
