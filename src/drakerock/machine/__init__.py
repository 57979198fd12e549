"""The machine (method section 2): SDFormat to plant, names, kinematics, motors, machine checks."""
