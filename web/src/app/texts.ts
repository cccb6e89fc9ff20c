/** Texts of the page frame, and page titles. */
export const texts = {
  product: "Telescope",
  /** Title of the browser tab. */
  tabTitle: (page: string): string => (page === "" ? "Telescope" : `${page} · Telescope`),
  skipToContent: "Skip to content",
  signedInAs: (name: string): string => `Signed in as ${name}`,
  signOut: "Sign out",
  checkingSession: "Checking your session…",
  sessionEnded: "retry",
  openIdExpired: "The sign-in took too long, or started in another browser. Start again.",
  openIdUninvited: "You have no invitation. Ask the administrator of this server for one.",
  openIdRefused: "The identity provider rejected the sign-in. Try again, or ask the administrator of this server.",

  sections: {
    title: "Main navigation",
    devices: "Devices",
    health: "Health",
    administration: "Administration",
    latency: "Latency",
    movements: "Movements",
    robotTypes: "Robot types",
  },
  pages: {
    account: "Your account",
    addRobotType: "Add a robot type",
    audit: "Audit log",
    healthOf: (name: string): string => `Health of ${name}`,
    invitation: "Invitation",
    keyframes: "Keyframes",
    latencyOf: (name: string): string => `Latency of ${name}`,
    multiRobot: (count: number): string => `${count} robots`,
    pair: "Pair a device",
  },
  link: {
    down: "No connection to the broker. All values are the last ones received; nothing on this page is live.",
    reconnecting: "Reconnecting…",
    refused: "The broker rejected the connection.",
    deviceListFailed: "The device list failed to load:",
  },
};
