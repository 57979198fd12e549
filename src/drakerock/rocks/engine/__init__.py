"""The nonsmooth rock engine: rigid convex rocks, a projected Gauss-Seidel contact solve, one step at a time.

Read `engine` first: it puts the parts of a step in order. Then, each with its derivation on top:

- `state`: what goes into a step and comes out of it; `records`: how it lies in memory.
- `collision`: from poses to contact points. `solve`: from contact points to velocities. `contact_law`: what force a
  contact has. `motion`: from velocities to poses.
- `contact_cache`: what is kept of contacts from step to step. `sleeping`: rocks that are taken out of the solve.
- `machine_step`: the machine as the solve sees it.
- `compiling`, `memory_access`, `solve.lanes`: how kernels get fast.

Terms are listed in docs/glossary.md, checks and figures in docs/validation/nonsmooth.md.
"""
