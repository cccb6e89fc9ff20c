"""Look up at the person in front, say hello, and nod."""

PARAMETERS = {
    "text": {"type": "string", "maxLength": 200, "default": "Hello, I am Qbo.", "description": "Spoken text"},
    "language": {"type": "string", "maxLength": 5, "default": "en", "description": "Language of the text"},
}

text = str(parameters.get("text", "Hello, I am Qbo."))

robot.look([0.8, 0.0, 0.75], speed=0.4)
if "say" in robot.can:
    robot.say(text, language=str(parameters.get("language", "en")))
print(text)
for tilt in (0.1, -0.35, 0.1):
    robot.move_joints({"head_tilt": tilt}, speed=0.35)
wait(0.3)
robot.home(speed=0.3)
