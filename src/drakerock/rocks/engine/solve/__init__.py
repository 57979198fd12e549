"""The contact solve: from contact rows to impulses and velocities, by projected Gauss-Seidel iterations."""
