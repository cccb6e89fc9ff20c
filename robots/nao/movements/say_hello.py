"""Look up at the person in front, say hello with a wave, and bow the head."""

PARAMETERS = {
    "text": {"type": "string", "maxLength": 200, "default": "Hello, I am NAO.", "description": "Spoken text"},
    "language": {"type": "string", "maxLength": 5, "default": "en", "description": "Language of the text"},
}

text = str(parameters.get("text", "Hello, I am NAO."))

robot.home(speed=0.3)
robot.look([0.8, 0.0, 0.6], speed=0.2)
robot.move_joints({"RShoulderPitch": -0.5, "RShoulderRoll": -0.3, "RElbowRoll": 1.2, "RHand": 0.9}, speed=0.3)
if "say" in robot.can:
    robot.say(text, language=str(parameters.get("language", "en")))
print(text)
for yaw in (0.5, -0.5, 0.5):
    robot.move_joints({"RWristYaw": yaw}, speed=0.2)
robot.home(speed=0.25)
robot.move_joints({"HeadPitch": 0.3}, speed=0.1)
wait(0.5)
robot.home(speed=0.2)
