export const texts = {
  title: "About this page",
  agent: {
    enroll: "Create an agent",
    run: "Run it",
  },
  firstSteps: {
    title: "Get started in three steps",
    explained:
      "A robot connects to Telescope through an agent, a program that runs next to it. Run these commands on the machine at the robot, in Telescope's folder, with its Python:",
    pair: "Pair it: open the link that the first command prints, or enter its code on this page. The robot then appears in this list.",
    simulated: "No robot? These commands simulate an arm. For another robot, replace ur5 with its type:",
    types: "all robot types",
    shared: "To use a robot that another person shares with you, ask them for an invitation link and open it here. You do not need an agent.",
  },
  pages: {
    devices: [
      "Each row is a device: a robot, or a room device such as a camera or a lamp. Open a device to see and control it.",
      "Online: the device sent data recently. Stale: its data is overdue. Offline: its agent is not connected.",
      "One operator at a time has control of a device. Every operator can stop it. Viewers can only watch.",
    ],
    space: [
      "The plan shows the room as its sensors measure it. Filled cells are occupied, light cells are free, dim cells are unknown.",
      "Robots and people are at their last known position, with a trail of the last 30 seconds. Grey means old.",
      "Numbers mark room devices. Open one to see its measurements.",
    ],
    device: [
      "Live view: the robot at its measured joint positions. The blue ghost shows the target. Nothing is extrapolated.",
      "Steering: moves the robot while you have control. A velocity applies only while you hold the button. Releasing it, or losing the connection, stops the motion.",
      "Actions (postures, speech, movements) run on their own. The status above shows their progress and cancels them.",
      "Camera, last 20 seconds and joint frames: images and values as the robot publishes them, several times a second.",
      "Latency: how long each stage of your last commands took. Events: what the robot reported about itself.",
      "Values turn grey or show their age once they are stale. Offline means that the agent is not connected: you see the last known values.",
      "Stop is always available, also with the Escape key. It latches until an operator resets it. Keep the robot's own emergency stop within reach.",
    ],
    roomDevice: [
      "Each card is one capability of this device: images, scans, values with their history, switches or sliders.",
      "The device publishes values when they change or at its own rate. Limits are shown next to each value.",
      "Below a slider, the applied value is shown. It can be less than the requested value.",
      "Values older than three periods turn grey and show their age (stale). Offline means that the agent is not connected.",
      "Stop ends the running action, also with the Escape key. It latches until an operator resets it.",
    ],
    robotTypes: [
      "A device is one robot. Its robot type defines what all robots of this kind have in common.",
      "Your own robot types are available to your devices. A newer version replaces the previous one after validation.",
    ],
  },
};
