"""The study's YAML: what is varied, what is measured, how much, and where it runs."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_origin

from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator
from pydantic_core import PydanticCustomError

from drakerock.config import Config, list_types, load_config
from drakerock.errors import InputError
from drakerock.exploration.config import ExplorationConfig
from drakerock.exploration.one_at_a_time import make_one_at_a_time
from drakerock.exploration.problem import Array, Problem, Variable
from drakerock.loading.scenario import Scenario
from drakerock.randomness import derive_seed
from drakerock.resources import find_study_file
from drakerock.study.objectives import get_objective, import_module


def _find_number(key: str) -> type:
    """Return int or float, whichever a scenario key holds; a PydanticCustomError if it is no such key."""
    model: type[BaseModel] | None = Scenario
    annotation: Any = None
    for part in key.split("."):
        if get_origin(annotation) is dict:
            return float  # of a part of one's own; `_check_parameters` knows its name
        names = model.model_fields if model is not None else {}
        if part not in names:
            near = difflib.get_close_matches(part, names, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            allowed = f"allowed here: {', '.join(sorted(names))}" if names else "there is nothing below it"
            raise PydanticCustomError(
                "key", "unknown scenario key '{key}' at '{part}'; {rest}",
                {"key": key, "part": part, "rest": hint + allowed},
            )  # fmt: skip
        annotation = names[part].annotation
        model = annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None
    kinds = list_types(annotation)
    if bool in kinds or not kinds & {int, float}:
        raise PydanticCustomError("key", "scenario key '{key}' is no number", {"key": key})
    return float if float in kinds else int


class Choice(Config):
    """One setting of a variable that is no number: scenario keys and their values."""

    label: str
    set: dict[str, Any] = Field(
        default={}, description="values by dotted scenario key; {}: the scenario as it is"
    )


class StudyVariable(Variable):
    """A design variable: a range and the scenario key that it sets, or choices between settings."""

    key: Annotated[
        str | None,
        Field(
            description="the scenario key it sets, dotted, such as loading.strategy.alpha; any number may be one"
        ),
    ] = None
    choices: Annotated[
        tuple[Choice, ...],
        Field(
            description="instead of key, low and high: the variable is 0, 1, ... for the first, second, ... of them"
        ),
    ] = ()

    @model_validator(mode="before")
    @classmethod
    def _number_choices(cls, data: Any) -> Any:
        if isinstance(data, dict) and isinstance(data.get("choices"), list | tuple) and data["choices"]:
            last = len(data["choices"]) - 1
            for name, value in (("low", 0), ("high", last)):
                if data.setdefault(name, value) != value:
                    raise ValueError(f"choices are numbered from 0 to {last}: leave {name} out")
        return data

    @model_validator(mode="after")
    def _check_origin(self) -> Self:
        if (self.key is None) == (not self.choices):
            raise ValueError(
                f"variable '{self.name}': give either key, low and high, or at least two choices"
            )
        return self

    @field_validator("key")
    @classmethod
    def _check_key(cls, key: str | None) -> str | None:
        if key is not None:
            _find_number(key)
        return key

    @property
    def is_integer(self) -> bool:
        """Whether the key holds whole numbers; the simulation then gets the variable's value rounded."""
        return self.key is None or _find_number(self.key) is int

    def describe(self, value: float) -> str:
        """Return a value for a person: the choice's label, or the number with its unit."""
        if self.choices:
            return self.choices[round(value)].label
        return f"{value:g}" if self.unit == "-" else f"{value:g} {self.unit}"

    def apply(self, value: float, data: dict[str, Any]) -> None:
        """Set a scenario's plain data to the variable's value."""
        if self.key is not None:
            changes: dict[str, Any] = {self.key: round(value) if self.is_integer else value}
        else:
            changes = self.choices[round(value)].set
        for key, item in changes.items():
            *parents, last = key.split(".")
            target = data
            for part in parents:
                target = target[part]
            if last not in target:
                raise ValueError(f"variable '{self.name}': unknown scenario key '{key}'")
            target[last] = item


class FailureConfig(Config):
    """What happens when a sequence fails: by an error, or by a failed cycle, which is its last."""

    retries: Annotated[int, Field(ge=0, le=10, description="further attempts before the point is marked")] = 2
    new_seed: Annotated[bool, Field(description="an attempt has its own seed, thus its own pile")] = True
    time_step_factor: Annotated[
        float, Field(gt=0, le=1, description="on the scenario's time step, once per further attempt")
    ] = 0.5
    max_failed_share: Annotated[
        float,
        Field(
            ge=0, lt=1, description="a sequence that lacks no more of its loadings, failed or not run, counts"
        ),
    ] = 0.1
    max_worker_deaths: Annotated[
        int,
        Field(ge=1, description="workers lost on end, without a finished cycle, before the sequence failed"),
    ] = 3


# Bytes, or with a unit: 4GB, 1.5 GiB, 500M.
_MEMORY = r"^\d+(\.\d+)?( ?([kKMGTP]i?)?B?)?$"


class SlurmConfig(Config):
    """Batch jobs, one worker each, asked of Slurm through dask-jobqueue."""

    queue: Annotated[str | None, Field(description="partition")] = None
    account: str | None = None
    walltime: Annotated[str, Field(pattern=r"^(\d+-)?\d{1,2}:\d{2}:\d{2}$", description="of one job")] = (
        "24:00:00"
    )
    memory: Annotated[str, Field(pattern=_MEMORY, description="of one job, such as 4GB")] = "4GB"
    directives: Annotated[tuple[str, ...], Field(description="further #SBATCH lines, without #SBATCH")] = ()
    prologue: Annotated[tuple[str, ...], Field(description="shell lines before the worker starts")] = ()


class ExecutorConfig(Config):
    """Where the sequences run. Has no influence on the results."""

    kind: Annotated[
        Literal["local", "serial", "slurm"],
        Field(description="processes of this machine; this process itself; batch jobs"),
    ] = "local"
    workers: Annotated[int | None, Field(ge=1, description="none: one per core; slurm: jobs, none: 10")] = (
        None
    )
    scheduler: Annotated[str | None, Field(description="address of a running Dask scheduler to use")] = None
    memory_limit: Annotated[
        str,
        Field(
            pattern=rf"^auto$|{_MEMORY}",
            description="per local worker, such as 4GB; auto: the memory's even share; 0: none",
        ),
    ] = "auto"
    slurm: SlurmConfig = SlurmConfig()


class CurveConfig(Config):
    """One measured curve: which signal it is compared with, over what, and how well it is known."""

    signal: Annotated[
        str,
        Field(description="a column of signals.parquet; or profile: the mean height of the pile that is dug"),
    ]
    over: Annotated[
        str, Field(description="the signal on the abscissa, such as time or x_T; of a profile: x")
    ] = "time"
    column: Annotated[
        str | None, Field(description="the measured values' column; null: called as the signal")
    ] = None
    over_column: Annotated[
        str | None, Field(description="the measured abscissae's column; null: as over")
    ] = None
    noise: Annotated[
        float | None,
        Field(
            gt=0, description="standard deviation of a value, in the signal's SI unit; null: from its scatter"
        ),
    ] = None
    model_error: Annotated[
        float,
        Field(ge=0, description="by how much a bin's mean may differ besides: what the model leaves out"),
    ] = 0.0
    shift: Annotated[float, Field(description="added to the measured abscissae, in SI: another zero")] = 0.0

    @property
    def measured(self) -> str:
        """The measured values' column."""
        return self.column or self.signal

    @property
    def measured_over(self) -> str:
        """The measured abscissae's column."""
        return self.over_column or self.over


class CalibrationConfig(Config):
    """What `drakerock calibrate` fits the study's variables to. Has no influence on what one point yields."""

    curves: Annotated[tuple[CurveConfig, ...], Field(min_length=1)]
    bins: Annotated[
        int, Field(ge=3, le=500, description="a curve is compared by the means of so many parts")
    ] = 24
    confidence: Annotated[float, Field(gt=0.5, lt=1, description="probability of the intervals")] = 0.95


class StorageConfig(Config):
    """What stays of a finished sequence."""

    keep: Annotated[
        Literal["everything", "outcomes"],
        Field(
            description="all files of each cycle (piles, signals, recording), or outcome, plan and height fields only"
        ),
    ] = "everything"


_METHOD_VARIABLES = tuple(
    StudyVariable(**variable.model_dump(), key=f"loading.strategy.{variable.name}")
    for variable in Problem().variables
)


class StudyConfig(Config):
    """A campaign: points of the design space, each a sequence of loadings."""

    file_fields = ("modules",)

    name: str = "study"
    seed: Annotated[int, Field(ge=0, description="of the sampling plan; the scenario has its own")] = 0
    scenario_file: Annotated[
        str | None, Field(description="the scenario all points share, relative to this file")
    ] = None
    scenario: Annotated[Scenario, Field(description="the scenario, or what differs from scenario_file")] = (
        Scenario()
    )
    variables: Annotated[tuple[StudyVariable, ...], Field(min_length=1)] = _METHOD_VARIABLES
    modules: Annotated[
        tuple[str, ...],
        Field(description="Python modules that register objectives: names, or .py files beside this one"),
    ] = ()
    objectives: Annotated[
        tuple[str, ...], Field(min_length=1, description="registered functions of a cycle's outcome")
    ] = ("production", "damage", "debris")
    loadings: Annotated[int, Field(ge=1, le=1000, description="loadings in a sequence")] = 20
    independent_piles: Annotated[
        bool, Field(description="each point has a seed and thus an original pile of its own")
    ] = False
    exploration: ExplorationConfig = ExplorationConfig()
    calibration: Annotated[
        CalibrationConfig | None, Field(description="measured curves that the variables are fitted to")
    ] = None
    failures: FailureConfig = FailureConfig()
    executor: ExecutorConfig = ExecutorConfig()
    storage: StorageConfig = StorageConfig()

    @model_validator(mode="after")
    def _check(self) -> Self:
        keys = [variable.key for variable in self.variables if variable.key is not None]
        self._check_parameters(keys)
        twice = sorted({key for key in keys if keys.count(key) > 1})
        if twice:
            raise ValueError(f"variables: one variable per scenario key; used twice: {', '.join(twice)}")
        try:
            for module in self.modules:
                import_module(module)
            problem = self.problem
        except ValidationError as error:
            raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None
        except InputError as error:
            raise ValueError(str(error)) from None
        self._check_design(problem)
        # The ends of every range must be scenarios; what lies between is then taken to be one.
        for variable in problem.variables:
            for end in (variable.low, variable.high):
                middle = {v.name: v.low + 0.5 * (v.high - v.low) for v in self.variables}
                try:
                    self._set_variables(middle | {variable.name: end})
                except ValidationError as error:
                    message = error.errors()[0]["msg"].removeprefix("Value error, ")
                    raise ValueError(
                        f"variables: {variable.name} = {end:g} is not a possible scenario: {message}"
                    ) from None
        return self

    def _check_design(self, problem: Problem) -> None:
        sampling = self.exploration.sampling
        if sampling.design != "one_at_a_time":
            return
        try:
            number = len(make_one_at_a_time(problem, sampling))
        except InputError as error:
            raise ValueError(str(error)) from None
        # Fewer: only the first of them are run.
        if sampling.n_samples > number or sampling.n_validation:
            raise ValueError(
                f"exploration.sampling: this design, one at a time, has {number} points: n_samples: {number}, "
                "n_validation: 0"
            )

    @property
    def problem(self) -> Problem:
        """Variables and objectives as the exploration knows them."""
        fields = Variable.model_fields
        return Problem(
            variables=tuple(Variable(**{name: getattr(v, name) for name in fields}) for v in self.variables),
            objectives=tuple(get_objective(name).objective for name in self.objectives),
        )

    def make_scenario(self, x: Array, point: str = "", attempt: int = 0) -> Scenario:
        """Return the scenario of one sequence.

        Args:
            x: (d,) the design point, in the variables' units.
            point: the point's identifier; of influence with `independent_piles` only.
            attempt: 0, or the number of the retry, which has another seed and a smaller time step.

        Raises:
            InputError: the values make no valid scenario.
        """
        values = dict(zip((v.name for v in self.variables), map(float, x), strict=True))
        try:
            scenario = self._set_variables(values)
        except ValidationError as error:
            message = error.errors()[0]["msg"].removeprefix("Value error, ")
            raise InputError(f"{values} make no valid scenario: {message}") from None
        seed, step = scenario.seed, scenario.dynamics.time_step
        if self.independent_piles:
            seed = derive_seed(seed, "point", point)
        if attempt:
            seed = derive_seed(seed, "attempt", attempt) if self.failures.new_seed else seed
            step *= self.failures.time_step_factor**attempt
        return scenario.replace(**{"seed": seed, "dynamics.time_step": step})

    def _check_parameters(self, keys: list[str]) -> None:
        """Raise ValueError for a parameter of a part that the scenario does not give: a misspelt one, most likely."""
        for key in keys:
            room, found, name = key.partition(".parameters.")
            if found:
                given = getattr(self.scenario.loading.parts, room.split(".")[-1]).parameters
                if name not in given:
                    near = f"it gives {', '.join(sorted(given))}" if given else "it gives none"
                    raise ValueError(f"variables: the scenario gives no parameter {key}; {near}")

    def _set_variables(self, values: Mapping[str, float]) -> Scenario:
        data = self.scenario.model_dump(mode="json")
        for variable in self.variables:
            try:
                variable.apply(values[variable.name], data)
            except (KeyError, TypeError) as error:
                raise ValueError(f"variable '{variable.name}': unknown scenario key at {error}") from None
        return Scenario.model_validate(data)

    def make_neutral(self) -> Self:
        """Return the study without what has no influence on its results.

        Where it runs, what is kept, how the results are analysed and how many points are wanted may be changed when a
        study is resumed.
        """
        sampling = self.exploration.sampling.replace(n_samples=1, n_validation=0)
        return self.replace(
            name="study",
            executor=ExecutorConfig(),
            storage=StorageConfig(),
            exploration=ExplorationConfig(sampling=sampling),
            calibration=None,
        )


def load_study(path: str | Path, overrides: Sequence[str] = ()) -> StudyConfig:
    """Read a study.

    The result is resolved: its scenario is whole, `scenario_file` is None, modules in files have full paths.

    Args:
        path: the YAML file.
        overrides: ``"dotted.key=value"`` strings on top of it, such as ``loadings=2`` or
            ``scenario.pile.rocks=100``.

    Raises:
        InputError: see `drakerock.config.load_config`; also an unknown scenario key or objective, a range
            that the scenario does not allow, a module that cannot be imported.
    """
    path = find_study_file(Path(path))

    def complete(data: dict[str, Any]) -> None:
        name, changes = data.get("scenario_file"), data.get("scenario") or {}
        if isinstance(name, str) and isinstance(changes, dict):
            # A shipped study may lie in a wheel: what it names is beside it.
            base = load_config(path.parent / name, Scenario).model_dump(mode="json")
            data["scenario"] = _merge(base, changes)

    first = load_config(path, _StudyFile, overrides, complete)
    data = first.model_dump(mode="json", exclude_unset=True)
    data.pop("scenario_file", None)
    data["modules"] = [
        str((path.parent / module).resolve()) if module.endswith(".py") else module
        for module in first.modules
    ]
    try:
        return StudyConfig.model_validate(data)
    except ValidationError as error:
        item = error.errors()[0]
        where = ".".join(str(part) for part in item["loc"])
        message = item["msg"].removeprefix("Value error, ")
        raise InputError(f"{path}: {where + ': ' if where else ''}{message}") from None


class _StudyFile(StudyConfig):
    """A study as it stands in its file: checks that need the whole scenario come after it is whole."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        return self


def _merge(base: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in changes.items():
        nested = isinstance(value, Mapping) and isinstance(result.get(key), dict)
        result[key] = _merge(result[key], value) if nested else value
    return result
