"""The machine (section 2 of the method): SDFormat to plant, names, kinematics, motors, and its checks.

A machine is one SDFormat file plus one `MachineConfig`. The file has to name what `names` lists; the linkage
behind boom and bucket is free.
"""
