"""The nonsmooth rock engine: rigid convex rocks, a projected Gauss-Seidel contact solve, one step at a time.

Plain functions over arrays, each concern in its own file; `engine` puts them in order, `system` is the
LeafSystem around it, `rocks.drake.plant_view` the machine's side. Formulation: docs/validation/nonsmooth.md.
"""
