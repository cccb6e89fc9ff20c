export const texts = {
  cameraSource: {
    title: "Camera",
    choose: "Source",
    own: (camera: string): string => `Robot: ${camera}`,
    from: (label: string, camera: string): string => `Room: ${label} (${camera})`,
  },

  room: {
    measuring: "Measurements",
    noDataYet: "No data received yet.",
    values: (stream: string): string => `Values: ${stream}`,
    name: "Name",
    value: "Value",
    late: (age: string): string => `Last value ${age}`,
    span: "Time range",
    spans: { "10min": "10 min", "1h": "1 h", "24h": "24 h" },
    limits: (low: string | null, high: string | null, unit: string): string => {
      if (low === null) return high === null ? "" : `Green: normal range, up to ${high} ${unit}.`;
      if (high === null) return `Green: normal range, from ${low} ${unit}.`;
      return `Green: normal range, ${low} to ${high} ${unit}.`;
    },
    chart: (label: string, low: string, high: string, unit: string): string => `Plot of ${label}: between ${low} and ${high} ${unit}`,
    chartEmpty: (label: string): string => `Plot of ${label}, no data yet`,
    noHistory: (reason: string): string => `Stored measurements failed to load: ${reason}`,
    assessment: { normal: "in the normal range", warning: "outside the normal range", outside: "outside its limits" },
    since: (when: string): string => `since ${when}`,
    sinceLonger: (when: string): string => `since ${when} or earlier`,
  },
  trend: {
    keys: "Point at the chart, or focus it and use the arrow keys, to read values.",
    noData: "No measurements in this time range.",
    at: (when: string, mean: string, band: readonly [string, string] | null): string =>
      band === null ? `${when}: ${mean}` : `${when}: ${mean} on average, from ${band[0]} to ${band[1]}`,
  },

  camera: {
    title: (name: string): string => `Camera: ${name}`,
    start: "Start live video",
    stop: "Stop live video",
    shot: "Take one image",
    taking: "Capturing…",
    off: "Live video is off.",
    waiting: "Waiting for the first image…",
    stalled: (age: string): string => `Last image received ${age}`,
    label: (name: string): string => `Image of the camera ${name}`,
    live: (width: number, height: number, rate: string, configured: string): string =>
      `Live, ${width} × ${height}, ${rate} of ${configured} Hz`,
    still: (width: number, height: number, age: string): string => `Still image, ${width} × ${height}, captured ${age}`,
    stopped: (age: string): string => `Stopped. Last image received ${age}.`,
    undecodable: "This browser cannot display an image that was received.",
  },

  depth: {
    title: "Depth image",
    shot: "Capture depth image",
    again: "Capture again",
    start: "Start live image",
    stop: "Stop live image",
    off: "The live image is off.",
    waiting: "Waiting for the first image…",
    none: "Capture an image to see distances.",
    label: (near: string, far: string): string =>
      `Depth image in false colours, from ${near} to ${far} m. Arrow keys move the measuring point.`,
    read: (m: string): string => `${m} m`,
    outOfRange: "out of range",
    hint: "Point at the image, or use the arrow keys, to read a distance.",
    noReading: "Grey: out of range.",
    captured: (width: number, height: number, age: string): string => `${width} × ${height}, captured ${age}`,
    received: (width: number, height: number, age: string): string => `${width} × ${height}, received ${age}`,
  },

  people: {
    title: "Tracked people",
    name: (id: number): string => `Person ${id}`,
    count: (count: number): string => (count === 0 ? "No person is tracked." : count === 1 ? "1 person is tracked." : `${count} people are tracked.`),
    key: "Solid: seen by the sensor. Dashed: inferred.",
  },

  scan: {
    title: "Lidar scan",
    shot: "Capture scan",
    label: (nearest: string): string => `Lidar view, to scale. Nearest: ${nearest} m.`,
    labelEmpty: "Lidar view; no data yet",
    live: "Arcs: nearest distance in each sector, live.",
    beams: (count: number, rate: string): string => `Dots: ${count} beams, live, ${rate} Hz.`,
    waiting: "Dots: waiting for the first scan…",
    stalled: (age: string): string => `Dots: none. Last scan received ${age}.`,
    points: (count: number, age: string): string => `Dots: ${count} beams of the scan captured ${age}.`,
    noPoints: "Capture a scan to see its beams.",
    showLive: "Show live scan",
    ahead: "forward",
    nearest: "Nearest",
  },

  settings: {
    title: "Settings",
    now: "now",
    slider: (label: string): string => `${label}: set value`,
    applying: "Applying…",
    applied: (value: string): string => `Applied: ${value}`,
    ends: { level: ["Off", "On"], opening: ["Closed", "Open"] } as Readonly<Record<string, readonly [string, string]>>,
    refused: (reason: string): string => `Not set: ${reason}`,
  },

  collect: {
    title: "Collect data",
    explain: "Measures at a chosen rate for a limited time. All viewers receive the data, and it is stored.",
    rate: "Samples per second",
    duration: "Duration",
    times: { "10": "10 s", "60": "1 min", "600": "10 min", "3600": "1 h" },
    start: "Start collecting",
    stop: "Stop collecting",
    measureOnce: "Measure once",
    running: (percent: number): string => `Collecting, ${percent} % done`,
    idle: "Not collecting: measures at the default rate.",
    invalidRate: "Enter a rate between 0.001 and 50 samples per second.",
    measuredOnce: (age: string): string => `Measured once, ${age}`,
    rateText: (stream: string, rate: string): string => `${stream}: ${rate} samples per second`,
    busy: "Another action is running.",
  },

  files: {
    title: "Captured files",
    none: "No captured files.",
    capture: (name: string): string => `Capture ${name}`,
    capturing: "Capturing…",
    download: "Download",
    downloadNamed: (name: string): string => `Download ${name}`,
    unreadable: "The file cannot be displayed. Download it from the list of captured files.",
  },
};
