/** List items with the commands that create and run an agent. */
import { texts } from "./texts";
import { CopyOnce } from "../ui/copy-once";
import "./help.css";

interface AgentCommandsProps {
  /** The device's name at its agent; also names the agent's folder. */
  name: string;
  type: string;
}

export function AgentCommands({ name, type }: AgentCommandsProps) {
  const words = texts.agent;
  const home = `~/${name}-agent`;
  const agent = "python -m device_agent";
  return (
    <>
      <li>
        <CopyOnce
          id="command-enroll"
          label={words.enroll}
          value={`${agent} enroll --home ${home} --server ${location.origin} --device ${name}=${type} --no-wait`}
        />
      </li>
      <li>
        <CopyOnce id="command-run" label={words.run} value={`${agent} run --home ${home}`} />
      </li>
    </>
  );
}
