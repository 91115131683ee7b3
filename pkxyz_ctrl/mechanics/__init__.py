"""The paper: stiffness, modes, workspace, linearisation, the choice of dimensions."""
