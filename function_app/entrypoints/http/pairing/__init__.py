"""Routes of agents: enrolment, claim, unpairing."""
