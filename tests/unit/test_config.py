import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakerock.config import calc_config_hash, load_config, parse_config
from drakerock.errors import InputError
from drakerock.loading.scenario import Scenario, load_scenario


def test_empty_text_means_all_defaults():
    assert parse_config("", Scenario) == Scenario()


def test_unknown_key_names_line_path_and_nearest():
    with pytest.raises(InputError) as caught:
        parse_config("seed: 1\nloading:\n  strategy:\n    alhpa: 1.0\n", Scenario, source="s.yaml")
    message = str(caught.value)
    assert message.startswith("s.yaml:4: unknown key 'loading.strategy.alhpa'")
    assert "did you mean 'alpha'?" in message
    assert "beta, gamma, kappa" in message


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("loading: {strategy: {alpha: 7}}", ["loading.strategy.alpha", "less than or equal to 2", "got 7"]),
        ("rocks: {density: -1}", ["rocks.density", "greater than 0"]),
        ("dynamics: {rocks: magic}", ["dynamics.rocks", "'plant'"]),
        ("site: {drift_width: .nan}", ["site.drift_width", "finite"]),
        ("rocks: {gradation: [{size_m: 0.3, mass_fraction: 0.5}]}", ["rocks", "sum to 1"]),
        (
            "rocks: {gradation: [{size_m: 0.3, mass_fraction: 1, color: red}]}",
            ["rocks.gradation.0.color", "size_m"],
        ),
        ("loading: 5", ["loading", "(got 5)"]),
        ("[1, 2]", ["keys and values at the top level"]),
        ("a: [1", ["not valid YAML"]),
    ],
)
def test_bad_values_say_what_is_allowed(text, parts):
    with pytest.raises(InputError) as caught:
        parse_config(text, Scenario)
    for part in parts:
        assert part in str(caught.value)


def test_override_reaches_nested_keys_and_is_named_in_errors():
    config = parse_config("", Scenario, ["loading.strategy.alpha=1.5", "site.void_depth=2"])
    assert config.loading.strategy.alpha == 1.5
    assert config.site.void_depth == 2.0
    with pytest.raises(InputError, match=r"^--set: unknown key 'loading.strategy.alfa'"):
        parse_config("", Scenario, ["loading.strategy.alfa=1.5"])
    with pytest.raises(InputError, match="expected key=value"):
        parse_config("", Scenario, ["loading.strategy.alpha"])


def test_missing_and_unreadable_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_config(tmp_path / "nothing.yaml", Scenario)
    with pytest.raises(InputError, match="cannot be read"):
        load_config(tmp_path, Scenario)
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read"):
        load_config(tmp_path / "b.yaml", Scenario)


def test_shipped_demo_is_valid():
    assert load_scenario().loading.strategy.model_dump() == {
        "alpha": 1.1,
        "beta": 0.5,
        "gamma": 0.5,
        "kappa": 0.5,
    }


@given(alpha=st.floats(0.2, 2.0), seed=st.integers(0, 10**9))
def test_hash_tells_configurations_apart(alpha, seed):
    base = Scenario()
    other = parse_config("", Scenario, [f"loading.strategy.alpha={alpha!r}", f"seed={seed}"])
    assert (calc_config_hash(base) == calc_config_hash(other)) == (base == other)
