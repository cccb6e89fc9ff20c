/** The commands that make an agent and run it, to be copied: items of a list of steps. */
import { texts } from "./texts";
import { CopyOnce } from "../../shared/ui/copy-once";
import "./help.css";

interface AgentCommandsProps {
  /** Of the device at its agent, and of the agent's folder. */
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
