import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakerock.config import load_config, parse_config
from drakerock.errors import InputError
from drakerock.identity import calc_config_hash
from drakerock.loading.config import StrategyConfig
from drakerock.loading.scenario import Scenario, load_scenario
from drakerock.study.schema import StudyConfig, load_study


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
    with pytest.raises(InputError, match=r"^override: unknown key 'loading.strategy.alfa'"):
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


def test_shipped_demo_is_the_defaults_but_for_its_strategy():
    demo, default = load_scenario(), Scenario()
    assert demo.loading.strategy != default.loading.strategy
    assert demo.replace(**{"loading.strategy": default.loading.strategy}) == default


@given(alpha=st.floats(0.2, 2.0), seed=st.integers(0, 10**9))
def test_hash_tells_configurations_apart(alpha, seed):
    base = Scenario()
    other = parse_config("", Scenario, [f"loading.strategy.alpha={alpha!r}", f"seed={seed}"])
    assert (calc_config_hash(base) == calc_config_hash(other)) == (base == other)


def refuse(text, *overrides, schema=Scenario):
    with pytest.raises(InputError) as caught:
        parse_config(text, schema, overrides, source="s.yaml")
    return str(caught.value)


def test_booleans_are_no_numbers_and_words_no_booleans():
    assert refuse("rocks:\n  friction: yes").startswith(
        "s.yaml:2: rocks.friction: input should be a valid number"
    )
    assert "(got 'yes')" in refuse("rocks: {friction: yes}")
    message = "must be a number, not true or false (got True)"
    assert refuse("pile: {rocks: true}") == f"s.yaml:1: pile.rocks: {message}"
    assert refuse("", "pile.rocks=true") == f"override: pile.rocks: {message}"
    assert "must be a number" in refuse("loading: {sensing: {scanner: {position: [true, 0, 0]}}}")
    for value in ("yes", "1", "'true'"):
        assert "independent_piles: must be true or false" in refuse(
            f"independent_piles: {value}", schema=StudyConfig
        )
    assert parse_config("independent_piles: true", StudyConfig).independent_piles


def test_where_text_is_expected_a_number_is_what_is_written():
    text = (
        "executor:\n  memory_limit: 0\n  slurm: {account: 00123, queue: 7, memory: 4000, directives: [1.50]}"
    )
    config = parse_config(text, StudyConfig, ["name=0x10", "executor.slurm.prologue=[12]"]).executor
    assert config.memory_limit == "0"
    assert (config.slurm.account, config.slurm.queue, config.slurm.memory) == ("00123", "7", "4000")
    assert (config.slurm.directives, config.slurm.prologue) == (("1.50",), ("12",))
    assert parse_config("", StudyConfig, ["name=0x10"]).name == "0x10"
    assert refuse("executor: {slurm: {account: true}}", schema=StudyConfig).endswith("quote it (got True)")
    assert "walltime" in refuse("executor: {slurm: {walltime: 90}}", schema=StudyConfig)
    assert "memory" in refuse("executor: {slurm: {memory: four}}", schema=StudyConfig)


def test_changing_is_checked_like_reading():
    config = Scenario().replace(**{"seed": 3, "loading.strategy.alpha": 1.3, "loading.strategy.beta": 0.2})
    assert config == parse_config("{seed: 3, loading: {strategy: {alpha: 1.3, beta: 0.2}}}", Scenario)
    assert config.replace() == config
    for change, message in (
        (
            {"loading.strategy.alpha": -3},
            "StrategyConfig: alpha: input should be greater than or equal to 0.2",
        ),
        ({"loading.strategy.alhpa": 1}, "StrategyConfig: unknown key 'alhpa'; did you mean 'alpha'?"),
        ({"laoding.strategy.alpha": 1}, "Scenario: unknown key 'laoding.strategy.alpha'"),
        ({"seed.alpha": 1}, "Scenario: unknown key 'seed.alpha': there is nothing below seed"),
        ({"dynamics.time_step": 2e-8}, "DynamicsConfig: time_step: input should be greater than 0.0001"),
        ({"pile.rocks": True}, "PileConfig: rocks: must be a number"),
        ({"site.void_height": 2.0}, "SiteConfig: void_height must be at least drift_height"),
    ):
        with pytest.raises(InputError) as caught:
            Scenario().replace(**change)
        assert str(caught.value).startswith(message)
    # pydantic's own way, which checks nothing by itself
    assert StrategyConfig().model_copy(update={"alpha": 1.3}) == StrategyConfig(alpha=1.3)
    assert StrategyConfig(alpha=1.3).model_copy() == StrategyConfig(alpha=1.3)
    with pytest.raises(InputError, match="alpha"):
        StrategyConfig().model_copy(update={"alpha": -3})


def test_shipped_studies_are_found_from_anywhere_and_a_file_that_is_there_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_scenario("studies/small.yaml").pile.rocks == 300
    assert load_study("studies/sensitivity.yaml").scenario.pile.rocks == 300
    with pytest.raises(
        InputError, match=r"studies/nothing.yaml: cannot be read|studies/nothing.yaml: no such"
    ):
        load_scenario("studies/nothing.yaml")
    (tmp_path / "studies").mkdir()
    (tmp_path / "studies" / "small.yaml").write_text("pile: {rocks: 7}")
    assert load_scenario("studies/small.yaml").pile.rocks == 7
