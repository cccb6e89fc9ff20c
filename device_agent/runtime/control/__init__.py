"""Control loop, controller and motion generation of one device."""
