import type { Delay } from "./model/delay-meter";
import { WATCHDOG_MS, type EndedBecause } from "./model/setpoint-streamer";
import type { SteeringMode } from "./model/steerable-parts";

const CAUSES: Readonly<Record<Delay["cause"], string>> = {
  browser: "this browser was busy",
  network: "the network was late",
  robot: "the robot's computer was late",
};

export const texts = {
  joints: {
    title: "Joints",
    target: (label: string): string => `${label}: target in degrees`,
    slider: (label: string): string => `${label}: target`,
    measured: (label: string): string => `${label}: measured`,
    heading: { joint: "Joint", target: "Target", measured: "Measured" },
    unit: "°",
    keys: "Arrow keys move by 1°, with Shift by 10°, with Alt by 0.1°. Or type a number and press Enter.",
    takeFirst: "Take control to move the robot.",
    waiting: "Waiting for the robot…",
    streaming: "Sending setpoints",
    busy: "An action is running.",
    stopped: "The robot is stopped.",
    limited: (limits: string): string => `Limited by the robot: ${limits}`,
    warning: ({ cause, ms }: Delay): string => `Slow: ${CAUSES[cause]} (${ms} ms). The robot stops within ${WATCHDOG_MS} ms without a setpoint.`,
    paused: (delay: Delay | null): string =>
      `Paused: no setpoint for ${delay === null ? `${WATCHDOG_MS} ms` : `${delay.ms} ms (${CAUSES[delay.cause]})`}. Release the control and press it again to continue.`,
    noDescription: "Waiting for the robot's description…",
    ended: {
      reached: "Target reached",
      stuck: "The robot stopped before the target",
      "released": "",
      stopped: "Ended: the robot is stopped",
      hidden: "Ended: the page was not visible",
      "no-telemetry": "Ended: no recent telemetry from the robot. Release the control and press it again to continue.",
      busy: "Ended: an action is running",
      "no-connection": "Ended: no connection for setpoints. Release the control and press it again to continue.",
    } satisfies Record<Exclude<EndedBecause, "paused" | null>, string>,
  },

  steer: {
    title: "Steering",
    modes: "Steering mode",
    mode: { joints: "Joints", jog: "Cartesian", drive: "Drive" } satisfies Record<SteeringMode, string>,
    holding: "Moves while you hold",
    showKeys: "Keyboard shortcuts",
    everywhere: "These keys work everywhere on this page, except in text fields",
    frame: "Frame",
    axes: "Reference axes",
    inBase: "Base",
    inTool: "Frame",
    along: "Translate",
    about: "Rotate",
    pad: (name: string, sign: 1 | -1): string => `${sign > 0 ? "Plus" : "Minus"} ${name}: moves while you hold it`,
    padShort: (name: string, sign: 1 | -1): string => `${sign > 0 ? "+" : "−"} ${name}`,
    linear: "Linear speed",
    angular: "Angular speed",
    millimetres: (value: number): string => `${Math.round(value)} mm/s`,
    metres: (value: number): string => `${value.toFixed(3)} m`,
    metresPerSecond: (value: number): string => `${(Math.abs(value) < 0.005 ? 0 : value).toFixed(2)} m/s`,
    degreesPerSecond: (value: number): string => `${Object.is(value, -0) ? 0 : value} °/s`,
    poseOf: (frame: string): string => `Pose of ${frame} in the base axes`,
    stick: "Virtual joystick: up drives forward, left and right turn. With keyboard focus here, arrow keys and W A S D drive while you hold them.",
    sideways: { left: "Left: moves while you hold it", right: "Right: moves while you hold it" },
    upTo: "Maximum speed",
    driveSpeed: (forward: number, turn: number): string => `${forward.toFixed(2)} m/s · ${Math.round(turn)} °/s`,
    target: "Target",
    measured: "Measured",
    part: { forward_m_s: "Forward", left_m_s: "Left", turn_rad_s: "Turn left" },
    keys: {
      joints: [
        [["1", "…", "9", "0"], "select a joint"],
        [["[", "]"], "previous and next joint"],
        [["↑", "↓"], "move the selected joint while held"],
      ],
      jog: [
        [["W", "S"], "plus and minus x while held"],
        [["A", "D"], "plus and minus y"],
        [["R", "F"], "plus and minus z"],
        [["O", "U"], "plus and minus roll"],
        [["I", "K"], "plus and minus pitch"],
        [["J", "L"], "plus and minus yaw"],
      ],
      drive: [
        [["W", "S", "↑", "↓"], "forward and back while held"],
        [["A", "D", "←", "→"], "turn left and right"],
        [["Q", "E"], "left and right, if the robot supports it"],
      ],
      always: [
        [["T"], "take or release control"],
        [["?"], "show or hide keyboard shortcuts"],
        [["Esc"], "stop"],
      ],
    } satisfies Record<SteeringMode | "always", [string[], string][]>,
    padKeys: {
      joints:
        "Gamepad: hold a shoulder button (LB or RB). The left stick moves the selected joint; the D-pad selects a joint. B stops.",
      jog: "Gamepad: hold a shoulder button (LB or RB). Left stick: x and y. Triggers: z. Right stick: roll and pitch. D-pad: yaw. B stops.",
      drive: "Gamepad: hold a shoulder button (LB or RB). The left stick drives; the right stick moves sideways if the robot supports it. B stops.",
    } satisfies Record<SteeringMode, string>,
    pads: {
      connected: (id: string): string => `Gamepad connected: ${id}. Hold a shoulder button to move the robot.`,
      disconnected: (id: string): string => `Gamepad disconnected: ${id}.`,
      unknown: (id: string): string => `This gamepad's layout is not supported, so it is ignored: ${id}.`,
    },
    noConnection: "Connecting for setpoints…",
    lostConnection: (reason: string): string => `No connection for setpoints: ${reason}`,
    noStreaming:
      "Manual control is not available: this robot's agent polls over HTTP and cannot receive setpoints. Use actions and movements, or connect the agent over MQTT.",
  },

  multiRobot: {
    title: (count: number): string => `${count} robots`,
    missing: "A device in this address does not exist, or you have no access to it.",
    stopAll: "Stop all",
    stopAllExplained: "The Escape key stops all robots on this page, regardless of the keyboard focus.",
    stopKey: "Esc",
    keysHere: "Keyboard and gamepad",
    keysFor: (label: string): string => `Keyboard and gamepad move ${label}.`,
  },
};
