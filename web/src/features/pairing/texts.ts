import { format } from "../../shared/i18n/format";

export const texts = {
  title: "Pair a device",
  byCode: "Claim code",
  explain:
    "Enter the code that the agent shows when it starts. It is valid for five minutes. If the terminal shows a QR code, scan it with a phone’s camera to open this page.",
  linked: "You followed a pairing link. Pair only an agent that you, or a person you trust, started.",
  into: (account: string): string => `The agent will belong to your account, ${account}, and its terminal will show that name.`,
  code: "Claim code",
  example: "BCDF-GHJK",
  space: "Space",
  firstSpace: "Your first space",
  newSpace: "New space…",
  spaceName: "Space name",
  submit: "Pair",
  busy: "Pairing…",
  discard: "Not this one",
  malformed: "A claim code has eight letters, such as BCDF-GHJK. It contains no vowels and no digits.",
  unknown:
    "Pairing failed: the code is wrong, expired or already used. The agent shows a new code every five minutes until it is paired. If you already paired it, it is in your device list.",
  done: (count: number): string => `Paired: ${format.count(count, "device")}`,
  doneNote: "These are the agent's devices. You can rename them; the name is visible to all accounts with access.",
  waiting: "Waiting for the first data…",
  another: "Pair another",
};
