"""The loading operation's part of the configuration (method section 5)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from drakerock.config import Config

Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]


class StrategyConfig(Config):
    """The four design variables (method section 5)."""

    alpha: Annotated[float, Field(ge=0.2, le=2, description="bucket fill ratio aimed at, V_d / V_b")] = 1.1
    beta: Annotated[Share, Field(description="dig height h_s2 / h_p: 0 deep, 1 shallow")] = 0.5
    gamma: Annotated[Share, Field(description="entry point: 1 front-most slice, 0 rear-most")] = 0.5
    kappa: Annotated[Share, Field(description="share of the curl done between s1 and s2")] = 0.5


class ScannerConfig(Config):
    """A scanner on the front unit: where it sits, what it sees, how well."""

    position: Annotated[
        tuple[float, float, float], Field(description="in the front unit's frame F: x, y, z [m]")
    ] = (0.3, 0.0, 2.0)
    pitch_deg: Annotated[
        float, Field(ge=-90, le=90, description="of its axis, downwards from F's x [deg]")
    ] = 5.0
    horizontal_field_deg: Annotated[float, Field(gt=0, le=360, description="[deg]")] = 120.0
    vertical_field_deg: Annotated[float, Field(gt=0, le=180, description="[deg]")] = 60.0
    resolution_deg: Annotated[float, Field(gt=0, le=10, description="angle between rays [deg]")] = 0.4
    range: Annotated[float, Field(gt=0, le=500, description="nothing farther is seen [m]")] = 40.0
    range_noise: Annotated[float, Field(ge=0, le=1, description="standard deviation [m]")] = 0.02
    dropout: Annotated[float, Field(ge=0, le=1, description="share of the rays that return nothing")] = 0.02
    distance: Annotated[float, Field(gt=0, le=100, description="bucket tip to brow when it scans [m]")] = 10.0


class SensingConfig(Config):
    """The height field and what is read from it."""

    kind: Annotated[
        Literal["ideal", "scanner"], Field(description="true surface seen from above, or the machine's scan")
    ] = "ideal"
    scanner: ScannerConfig = ScannerConfig()
    cell: Annotated[float, Field(gt=0.02, le=2, description="grid spacing [m]")] = 0.26
    front_height: Annotated[float, Field(gt=0, le=2, description="the front is where h exceeds this [m]")] = (
        0.15
    )


class PlanningConfig(Config):
    """The dig plan's limits and speeds."""

    file_fields = ("source",)

    source: Annotated[str | None, Field(description="a stored plan.json to execute instead of planning")] = (
        None
    )
    v_x_max: Annotated[float, Field(gt=0, le=5, description="forward and reverse speed [m/s]")] = 1.3
    r_ft: Annotated[
        float | None,
        Field(
            gt=0,
            le=20,
            description="reach that scales the dig height, h_p [m]; null: the machine's, at 40 deg",
        ),
    ] = None
    tilt_rate: Annotated[float, Field(gt=0, le=3, description="bucket's rate on [s2, s3] [rad/s]")] = 0.5
    ramp: Annotated[
        float,
        Field(gt=0, le=0.5, description="share of [s1, s2] over which the speeds ramp down to the halt"),
    ] = 0.15
    wall_clearance: Annotated[float, Field(ge=0, le=2, description="machine to drift wall [m]")] = 0.15
    stop_margin: Annotated[
        float, Field(ge=0, le=0.3, description="full tilt is planned this far inside the joint stop [rad]")
    ] = 0.02
    floor_clearance: Annotated[
        float, Field(ge=0, le=0.5, description="tip above the floor while it is lowered [m]")
    ] = 0.03
    run_up: Annotated[float, Field(gt=0, le=30, description="tip to s0 when the loading starts [m]")] = 1.5
    n_segment: Annotated[int, Field(ge=10, le=2000, description="path points a segment")] = 60


class WeightTransferConfig(Config):
    """Raising the boom during the push: the pile's weight on the bucket loads the front wheels."""

    height: Annotated[
        float, Field(ge=0, le=1, description="how far the tip is raised on [s0, s1]; 0: not at all [m]")
    ] = 0.0
    rate: Annotated[float, Field(gt=0, le=1, description="the boom's rate meanwhile [rad/s]")] = 0.02


class ControlConfig(Config):
    """The feed-forward controller."""

    speed_floor: Annotated[
        float, Field(gt=0, le=1, description="lowest speed before a waypoint, share of its segment's maximum")
    ] = 0.1
    timeout: Annotated[float, Field(gt=0, description="allowed beyond a segment's planned time [s]")] = 5.0
    approach_time: Annotated[float, Field(gt=0, description="allowed from the start to s0 [s]")] = 20.0
    weight_transfer: WeightTransferConfig = WeightTransferConfig()


class SteeringConfig(Config):
    """Articulation steering: holds the plan's line across the drift."""

    hold_line: Annotated[
        bool,
        Field(
            description="steer back to the plan's line before s0 and after s3; false: the angle "
            "machine.steering_angle_deg is held"
        ),
    ] = False
    preview: Annotated[
        float, Field(ge=0.5, le=50, description="way over which offset and heading decay [m]")
    ] = 4.0
    limit_deg: Annotated[float, Field(gt=0, le=45, description="largest angle of the articulation [deg]")] = (
        15.0
    )
    rate_deg: Annotated[float, Field(gt=0, le=60, description="largest rate of the articulation [deg/s]")] = (
        8.0
    )
    least_speed: Annotated[
        float, Field(ge=0, le=1, description="slower than this the angle is held: tyres would scrub [m/s]")
    ] = 0.1


class PerformanceConfig(Config):
    """Objectives and events."""

    tau_c: Annotated[
        float | None,
        Field(gt=0, description="critical hinge moment [N m]; null: machine.expected.critical_moment"),
    ] = None
    t_char: Annotated[float, Field(gt=0, description="characteristic time of the damage integral [s]")] = 12.0
    loose_packing: Annotated[
        float,
        Field(gt=0, le=1, description="share of solid rock in the load's loose volume, for the fill factor"),
    ] = 0.58
    settle_time: Annotated[
        float, Field(ge=0, le=60, description="at most this long after s4 for the rocks to rest [s]")
    ] = 6.0
    rest_speed: Annotated[
        float, Field(gt=0, description="rocks rest when all are slower than this, on average ... [m/s]")
    ] = 0.05
    rest_window: Annotated[float, Field(gt=0, le=10, description="... over this time [s]")] = 0.5
    weighing_delay: Annotated[
        float, Field(ge=0, le=10, description="after s4, until the braked machine is weighed [s]")
    ] = 0.3
    weighing_time: Annotated[
        float, Field(ge=0.1, le=10, description="the weight is the mean over this time: the load rocks [s]")
    ] = 0.5
    weighing_tolerance: Annotated[
        float, Field(gt=0, description="weight and counted load that differ by more are an event [kg]")
    ] = 150.0
    stall_speed: Annotated[
        float, Field(gt=0, description="stall: slower than this while told to drive on [m/s]")
    ] = 0.05
    slip_ratio: Annotated[
        float, Field(gt=0, description="slip event: |v_wheel - v| / v_x_max above this")
    ] = 0.5
    event_time: Annotated[float, Field(ge=0, description="shortest stall or slip that counts [s]")] = 0.2
    wall_gap: Annotated[
        float, Field(ge=0, description="contacts with a wall that are less apart are one event [s]")
    ] = 0.5


class PartConfig(Config):
    """A part of one's own in place of ours."""

    file_fields = ("system",)

    system: Annotated[
        str | None,
        Field(
            pattern=r"^[\w./-]+:\w+$",
            description="module:function or file.py:function that makes it; null: ours",
        ),
    ] = None
    parameters: dict[str, float | int | bool | str] = Field(
        default={}, description="what the function gets by name; numbers can be a study's variables"
    )


class PartsConfig(Config):
    """Controller, planner and sensor of one's own (`drakerock.loading.parts`)."""

    controller: PartConfig = PartConfig()
    planner: PartConfig = PartConfig()
    sensor: PartConfig = PartConfig()


class LoadingConfig(Config):
    """Everything about one loading cycle but machine, site and rocks."""

    strategy: StrategyConfig = StrategyConfig()
    sensing: SensingConfig = SensingConfig()
    planning: PlanningConfig = PlanningConfig()
    control: ControlConfig = ControlConfig()
    steering: SteeringConfig = SteeringConfig()
    performance: PerformanceConfig = PerformanceConfig()
    parts: PartsConfig = PartsConfig()
