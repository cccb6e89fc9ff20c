"""Rejected uploads and the reported reasons."""

import base64

import pytest

from function_app.services.robot_types.package_reader import MAX_BYTES, MAX_FILES
from tests.harness.cloud.cloud import Person, problem
from tests.integration.robot_types.lever import FILES, LEVER, add, blobs, manifest


@pytest.mark.parametrize(
    ("xml", "words"),
    [
        ("<mujoco><worldbody><body></worldbody></mujoco>", ["lever.xml", "XML_ERROR_MISMATCHED_ELEMENT", "Line"]),
        (LEVER.replace('type="box"', 'type="boxx"'), ["lever.xml", "invalid keyword: 'boxx'", "line 4"]),
        (LEVER.replace("<site", "<sight"), ["lever.xml", "unrecognized element", "'sight'", "line 8"]),
        (
            LEVER.replace("<worldbody>", '<asset><mesh name="m" file="nothing.stl"/></asset><worldbody>'),
            ["lever.xml", "nothing.stl"],
        ),
        (LEVER.replace("<worldbody>", '<include file="more.xml"/><worldbody>'), ["lever.xml", "more.xml"]),
        (LEVER.replace("<worldbody>", '<include file="lever.xml"/><worldbody>'), ["lever.xml", "already included"]),
        (LEVER.replace('range="-1 1"', 'range="-0.5 0.5"'), ["range of joint 'shoulder' is -0.5000 to 0.5000"]),
        (LEVER.replace('ctrlrange="-1 1"', 'ctrlrange="0 1"'), ["control range of actuator 'shoulder'"]),
        (LEVER.replace("<position", "<motor").replace(' kp="50"', ""), ["'shoulder' is not a position servo"]),
        (LEVER.replace('<position name="shoulder"', '<position name="hip"'), ["no actuator 'shoulder'", "has: hip"]),
        (LEVER.replace('<site name="tip"', '<site name="top"'), ["no site or body 'tip'", "top"]),
        (
            LEVER.replace(' range="-1 1" axis="0 1 0"', ' type="ball"')
            .replace("<actuator>", "<!--")
            .replace("</actuator>", "-->"),
            ["neither a hinge nor a slide"],
        ),
        (
            LEVER.replace('mass="0.5"', 'mass="1e-9"')
            .replace('kp="50"', 'kp="1e9"')
            .replace(' forcerange="-20 20"', ""),
            ["unstable at home"],
        ),
        ("", ["lever.xml", "empty"]),
        ("<mujoco/>", ["no joint 'shoulder'"]),
        ("<robot name='x'/>", ["lever.xml"]),
        ("\x00\x01", ["lever.xml"]),
    ],
)
def test_errors_of_mujoco_are_reported_unchanged(bert: Person, xml: str, words: list[str]) -> None:
    refused = problem(add(bert, lever__xml=xml), 422, "robot-type-rejected")
    text = " ".join(refused["errors"])
    for word in words:
        assert word in text
    assert "/tmp" not in text


def test_wheels_without_an_actuator_in_the_model_are_rejected(bert: Person) -> None:
    wheels = '[simulation.wheels]\nleft = "shoulder"\nright = "wheel"\nradius_m = 0.05\ntrack_m = 0.3\n'
    refused = problem(add(bert, text=manifest() + wheels), 422, "robot-type-rejected")
    assert refused["errors"] == [
        "lever.xml: actuator 'shoulder' is not a velocity servo on a hinge, with a control range.",
        "lever.xml: no actuator 'wheel'; the model has: shoulder.",
    ]


@pytest.mark.parametrize(
    "inside",
    [
        *(f'<include file="{name}"/>' for name in ("/etc/passwd", "../1/lever.xml", "a/../../x.xml")),
        '<include file="..\\\\x.xml"/>',
        '<include file="&#47;etc/passwd"/>',
        '<asset><mesh name="m" file="/etc/hosts.stl"/></asset>',
        '<asset><texture name="t" type="skybox" fileup="/x.png"/></asset>',
        '<asset><hfield name="h" file="C:x.png" size="1 1 1 1"/></asset>',
        *(f"<compiler {value}/>" for value in ('meshdir="/usr"', 'texturedir=".."', 'assetdir="~"')),
    ],
)
def test_a_reference_outside_the_folder_is_rejected_without_reading_it(bert: Person, inside: str) -> None:
    before = blobs(bert.cloud)
    refused = problem(
        add(bert, lever__xml=LEVER.replace("<worldbody>", inside + "<worldbody>", 1)), 422, "robot-type-invalid"
    )
    assert "lever.xml" in refused["detail"]
    assert blobs(bert.cloud) == before


def test_entities_are_rejected(bert: Person) -> None:
    doctype = '<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>'
    problem(add(bert, lever__xml=doctype + LEVER), 422, "robot-type-invalid")


def test_files_that_only_mujoco_can_parse_are_rejected(bert: Person) -> None:
    """MuJoCo's parser accepts more than the checker's, which therefore cannot check the references in such files."""
    lenient = LEVER.replace('model="lever"', 'model="&nothing;"')
    refused = problem(add(bert, lever__xml=lenient), 422, "robot-type-rejected")
    assert "undefined entity" in refused["errors"][0]


@pytest.mark.parametrize(
    "name",
    [
        "../x.xml", "/x.xml", "a/../x.xml", "a//x.xml", "./x.xml", ".x.xml", "a\\x.xml", "C:x.xml", "x.XML", "x.xml/",
        "x.py", "robot.toml", "x.so", "x", "", "x\x00.xml", "ä.xml", "a/b/c/d/e.xml", "x" * 130 + ".xml",
        "lever.xml/x.xml", "PK\x03\x04.xml",
    ],
)  # fmt: skip
def test_an_invalid_file_name_is_rejected(bert: Person, name: str) -> None:
    body = {"manifest": manifest(), "files": {**FILES, name: "<mujoco/>"}}
    problem(bert.post("/robot-types", body), 422, "robot-type-invalid")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"type": '"a b"'}, "type"), ({"type": '"../x"'}, "type"), ({"type": f'"{"x" * 65}"'}, "type"),
        ({"version": "0"}, "version"), ({"version": "10000000"}, "version"), ({"version": '"x"'}, "version"),
        ({"model": '"other.xml"'}, "lever.xml, scene.xml"), ({"model": '"robot.toml"'}, "model"),
        ({"scene": '"../scene.xml"'}, "scene"), ({"period_ms": "0"}, "period_ms"),
        ({"braking_rad_s2": "nan"}, "braking_rad_s2"), ({"lower_rad": "-inf"}, "lower_rad"),
        ({"max_velocity_rad_s": "0"}, "max_velocity_rad_s"), ({"home_rad": "{}"}, "home_rad"),
        ({"home_rad": "{ shoulder = 2 }"}, "home_rad"), ({"home_rad": "{ shoulder = nan }"}, "home_rad"),
        ({"label": ""}, "label"), ({"label": "="}, "line"), ({"driver": '"mujoco"\nsurprise = 1'}, "surprise"),
    ],
)  # fmt: skip
def test_a_manifest_error_names_the_field(bert: Person, change: dict[str, str], words: str) -> None:
    refused = problem(add(bert, text=manifest(**change)), 422, "manifest-invalid")
    assert words in refused["detail"]


def test_sizes_are_limited(bert: Person) -> None:
    many = {f"f{number}.xml": "<mujoco/>" for number in range(MAX_FILES - 1)}
    problem(bert.post("/robot-types", {"manifest": manifest(), "files": {**FILES, **many}}), 422, "invalid")
    for content in (base64.b64encode(bytes(MAX_BYTES)).decode(), "%"):
        body = {"manifest": manifest(), "files": {**FILES, "m.stl": content}}
        problem(bert.post("/robot-types", body), 422, "robot-type-invalid")


def test_a_large_mesh_is_accepted(bert: Person) -> None:
    body = {"manifest": manifest(), "files": {**FILES, "m.png": base64.b64encode(bytes(5_900_000)).decode()}}
    added = bert.post("/robot-types", {**body, "wait_ms": 30_000})
    assert added.status_code in {200, 201}, added.text
    assert added.json()["files"]["m.png"] == 5_900_000
