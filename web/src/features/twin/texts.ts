import type { Quantity } from "./model/recent-telemetry";

export const texts = {
  view: {
    title: "Live view",
    label: "3D view of the robot. Drag to rotate, scroll to zoom.",
    waiting: "Waiting for the robot's model…",
    noWebgl: "3D views are not available (WebGL is disabled or missing). All other functions work.",
    failed: "The live view failed to load. All other functions work.",
    staleNote: "Last known pose",
    ghost: "Solid: measured. Blue: target.",
    reset: "Reset view",
  },

  plot: {
    title: "Last 20 seconds",
    quantity: {
      position_rad: "Position",
      velocity_rad_s: "Velocity",
      effort_nm: "Effort",
    } satisfies Record<Quantity, string>,
    unit: { position_rad: "°", velocity_rad_s: "°/s", effort_nm: "N m" } satisfies Record<Quantity, string>,
    choose: "Quantity",
    joints: "Joints to plot",
    /** A joint's limits; one number if they are symmetric. */
    limits: ([low, high]: readonly [number, number], unit: string): string => {
      const text = (value: number): string => String(Number(value.toPrecision(3)));
      return low === -high ? `±${text(high)} ${unit}` : `${text(low)} to ${text(high)} ${unit}`;
    },
    label: (quantity: string): string => `Plot of ${quantity} over the last 20 seconds`,
  },

  poses: {
    title: "Joint frames",
    table: "Table of joint frames",
    frame: "Frame",
    position: "Position (m)",
    rotation: "Rotation",
    asDegrees: "Roll, pitch, yaw (°)",
    asQuaternion: "Quaternion (w, x, y, z)",
    none: "This device publishes no frames.",
    source: "Frames",
    publishedFrames: "Published",
    joints: "All joints",
    computedFrames: "Computed on this page by forward kinematics from the robot's model and the measured joint positions.",
    old: "Last known values.",
    showAs: "Rotation format",
  },
};
