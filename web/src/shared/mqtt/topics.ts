/** Topics, equal to device_agent/protocol/topics.py. `base` is a device's `ts/v1/{space}/{agent}/{device}`. */

export interface DeviceTopics {
  conn: string;
  desc: string;
  twin: string;
  state: string;
  /** Filter for all measurement streams. */
  tele: string;
  joints: string;
  cam: (name: string) => string;
  event: string;
  ack: string;
  /** Stop by the account `author`. */
  stop: (author: string) => string;
  ctl: (epoch: number) => string;
}

export function deviceTopics(base: string): DeviceTopics {
  return {
    conn: `${base.slice(0, base.lastIndexOf("/"))}/conn`,
    desc: `${base}/desc`,
    twin: `${base}/desc/twin`,
    state: `${base}/state`,
    tele: `${base}/tele/+`,
    joints: `${base}/tele/joints`,
    cam: (name) => `${base}/cam/${name}`,
    event: `${base}/event`,
    ack: `${base}/ack`,
    stop: (author) => `${base}/stop/${author}`,
    ctl: (epoch) => `${base}/ctl/${epoch}`,
  };
}

/** Whether an MQTT filter matches a topic. */
export function matches(filter: string, topic: string): boolean {
  const filterLevels = filter.split("/");
  const topicLevels = topic.split("/");
  if (filterLevels.at(-1) !== "#" && filterLevels.length !== topicLevels.length) return false;
  return filterLevels.every((level, index) => level === "#" || (index < topicLevels.length && (level === "+" || level === topicLevels[index])));
}
