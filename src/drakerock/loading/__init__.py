"""The loading operation (method section 5): sensing, planning, control, performance, one cycle."""
