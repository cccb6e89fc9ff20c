/** The next step after adding a robot type: start an agent. */
import { AgentCommands } from "../../shared/help";
import { Card } from "../../shared/ui/card";
import { texts } from "./texts";

/** `builtIn`: the agent has the type already. */
export function StartAgent({ type, builtIn }: { type: string; builtIn: boolean }) {
  const words = texts.next;
  return (
    <Card title={words.title}>
      <p>{words.agent}</p>
      <ol class="next-steps">
        {!builtIn && <li>{words.folder(type)}</li>}
        <AgentCommands name={type} type={type} />
        <li>{words.code}</li>
      </ol>
    </Card>
  );
}
