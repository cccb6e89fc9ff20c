"""The template of new drivers fulfils the driver contract, with and without a base."""

from device_agent.drivers.testing.template.base_driver import TemplateBaseDriver
from device_agent.drivers.testing.template.test_driver import TestTemplateDriver as TemplateContract


class TestArm(TemplateContract):
    """As it is created for an arm."""


class TestBase(TemplateContract):
    """As it is created for a robot with a base."""

    driver_class = TemplateBaseDriver
    type_name = "qbo"
