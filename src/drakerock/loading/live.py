"""A loading in a browser while it is computed: machine, drift and all rocks in Meshcat."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.systems.framework import DiagramBuilder

from drakerock.loading.parts import StationView
from drakerock.loading.scenario import Scenario
from drakerock.loading.station import Station, make_station
from drakerock.rocks.state import PileState

# Of what is shown [1/s of simulated time]: each frame tells the browser of every rock.
FRAME_RATE = 10.0


def make_live_station(scenario: Scenario, pile: PileState, meshcat: Meshcat) -> Station:
    """Return a station that shows itself in `meshcat` as it is simulated, seen from the side.

    Raises:
        InputError: as `make_station`.
    """

    def show(builder: DiagramBuilder, view: StationView) -> None:
        MeshcatVisualizer.AddToBuilder(
            builder, view.scene_graph, meshcat, MeshcatVisualizerParams(publish_period=1.0 / FRAME_RATE)
        )

    toe = float(np.percentile(pile.p_WRs[:, 0], 2)) if len(pile) else 0.0
    height = scenario.site.drift_height
    # Through the near wall, which is drawn all but transparent.
    eye = np.array([toe - 5.0, -scenario.site.drift_width - 4.0, 0.8 * height])
    meshcat.SetCameraPose(eye, np.array([toe - 1.0, 0.0, 0.2 * height]))
    return make_station(scenario, pile, visible=True, extend=show)
