/** Parses validation errors into file, line and kind, so that the page can give advice. */

type FindingKind =
  | "range"
  | "missing"
  | "malformed"
  | "keyword"
  | "element"
  | "unnamed"
  | "servo"
  | "shape"
  | "unstable"
  | "outside"
  | "manifest"
  | "field"
  | "script"
  | "builtIn"
  | "heavy"
  | "checker"
  | "camera"
  | "idle"
  | "mesh"
  | "invisible"
  | "other";

export interface Finding {
  /** Relative to the folder; empty: not about one file. */
  file: string;
  line: number | null;
  kind: FindingKind;
  /** The message without file and line. */
  message: string;
  /** The affected name, such as a joint or file; may be empty. */
  subject: string;
  /** For a range error: the range that the model allows [rad]. */
  range_rad: readonly [number, number] | null;
}

const FILE = /^([\w./ -]+\.(?:xml|toml|py|stl|obj|png)):\s*/;
const LINES = [/\(at line (\d+)[^)]*\)/, /\(line (\d+)\)/, /Line number=(\d+)/, /\bline (\d+)/i];
const RANGE = /range of (?:joint|actuator) '[^']*' is (-?[\d.]+) to (-?[\d.]+)/;

/** The first match applies, so patterns with only a line are last. */
const KINDS: readonly (readonly [FindingKind, RegExp])[] = [
  ["range", RANGE],
  ["missing", /is not among the files/],
  ["builtIn", /is part of the installation/],
  ["outside", /leads out of the robot type's folder|DOCTYPE/],
  ["unnamed", /^no (joint|actuator|site or body) '/],
  ["servo", /servo/],
  ["shape", /neither a hinge nor a slide/],
  ["unstable", /unstable at home/],
  ["heavy", /Simplify/],
  ["checker", /checker|validator|interrupted|is missing. Upload it again/],
  ["camera", /there is no camera/],
  ["idle", /so it cannot be moved/],
  ["mesh", /meshes are shown as boxes/],
  ["invisible", /nothing of it can be seen|too many parts/],
  ["element", /unrecognized element|Schema violation/i],
  ["keyword", /invalid keyword|unrecognized attribute/i],
  ["malformed", /XML_ERROR|mismatched tag|not well-formed|unclosed token|no element found|undefined entity|XML parse error/i],
];

export function readFinding(error: string): Finding {
  const file = FILE.exec(error)?.[1] ?? "";
  const message = error.slice(FILE.exec(error)?.[0].length ?? 0);
  const line = LINES.map((each) => each.exec(message)?.[1]).find((found) => found !== undefined);
  const range = RANGE.exec(message);
  return {
    file,
    line: line === undefined ? null : Number(line),
    kind: kindOf(file, message),
    message: withoutLine(message),
    subject: /'([^']*)'/.exec(message)?.[1] ?? "",
    range_rad: range === null ? null : [Number(range[1]), Number(range[2])],
  };
}

/** All findings, sorted by file and line. Findings without a file come first. */
export function readFindings(errors: readonly string[]): Finding[] {
  const findings = errors.map(readFinding);
  return findings.sort((one, other) => one.file.localeCompare(other.file) || (one.line ?? 0) - (other.line ?? 0));
}

function kindOf(file: string, message: string): FindingKind {
  const matched = KINDS.find(([, pattern]) => pattern.test(message))?.[0];
  if (matched !== undefined && !(file.endsWith(".py") || file === "robot.toml") ) return matched;
  if (file.endsWith(".py")) return "script";
  if (file === "robot.toml") return /at line \d+/.test(message) ? "manifest" : "field";
  return "other";
}

/** Removes the line number, which is shown separately. */
function withoutLine(message: string): string {
  return message
    .replace(/\s*\((?:at )?line \d+[^)]*\)/, "")
    .replace(/^Line \d+: /, "")
    .replace(/^(?:XML )?Error: /, "")
    .trim();
}
