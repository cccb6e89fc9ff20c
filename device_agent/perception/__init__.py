"""What a room's sensors say together: where things stand, who moves where. NumPy alone; no simulation, no driver."""
