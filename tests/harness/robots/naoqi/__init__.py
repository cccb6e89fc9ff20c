"""NAOqi's services over the real protocol, for tests of its driver."""
