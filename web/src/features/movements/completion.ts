/** Completions for a script: calls of the sandbox API and names of the robot type. */
import type { Completion, CompletionContext, CompletionResult } from "@codemirror/autocomplete";
import { syntaxTree } from "@codemirror/language";
import type { EditorState } from "@codemirror/state";
import type { SyntaxNode } from "@lezer/common";
import type { ScriptCall, ScriptParameter, Scripting } from "../../shared/api/movement-library";

const WORD = /[\w]*$/;
const NAME = /^[^'"\n]*$/;

/** `parameters`: the names in the script's current `PARAMETERS`. */
export function complete(
  scripting: Scripting,
  context: CompletionContext,
  parameters: readonly string[],
): CompletionResult | null {
  const { state, pos } = context;
  const node = syntaxTree(state).resolveInner(pos, -1);
  if (node.name === "Comment") return null;
  const string = enclosing(node, "String");
  if (string !== null) return inString(scripting, state, string, pos, parameters);
  const word = context.matchBefore(WORD);
  const from = word?.from ?? pos;
  const before = state.sliceDoc(Math.max(0, from - 200), from);
  const owner = /(\w+)\.$/.exec(before)?.[1];
  if (owner !== undefined) return options(from, members(scripting, owner));
  if (/(^|\n)[ \t]*(from|import)[ \t]+$/.test(before)) return options(from, scripting.api.modules.map(moduleOption));
  // At an empty place, completions need an explicit request.
  if (from === pos && !context.explicit) return null;
  const call = callAt(scripting, state, node);
  return options(from, [...(call === null ? [] : call.parameters.flatMap(keyword)), ...globals(scripting)]);
}

function options(from: number, found: Completion[]): CompletionResult | null {
  return found.length === 0 ? null : { from, options: found, validFor: /^\w*$/ };
}

function members({ api }: Scripting, owner: string): Completion[] {
  const value = api.values.find(({ name }) => name === owner);
  if (value === undefined) return [];
  return [
    ...(value.methods ?? []).map(callOption),
    ...(value.attributes ?? []).map(({ name, type, doc }) => ({ label: name, type: "property", detail: type, info: doc })),
  ];
}

function globals({ api }: Scripting): Completion[] {
  return [
    ...api.functions.map(callOption),
    ...api.values.map(({ name, type, doc }) => ({
      label: name,
      type: type === "exception" ? "class" : "variable",
      detail: type,
      info: doc,
      boost: 2,
    })),
  ];
}

function callOption({ name, signature, doc, details }: ScriptCall): Completion {
  return { label: name, type: "function", detail: signature.slice(name.length), info: details ?? doc, boost: 1 };
}

function moduleOption(name: string): Completion {
  return { label: name, type: "namespace" };
}

function keyword(parameter: ScriptParameter): Completion[] {
  if (parameter.kind === "rest") return [];
  const detail = [parameter.type, parameter.default === undefined ? "" : `= ${parameter.default}`].join(" ").trim();
  return [{ label: parameter.name, apply: `${parameter.name}=`, type: "property", detail, boost: 3 }];
}

/** Completions inside strings: joints, postures and other names, and parameter names. */
function inString(
  scripting: Scripting,
  state: EditorState,
  string: SyntaxNode,
  pos: number,
  parameters: readonly string[],
): CompletionResult | null {
  const quote = /^\w*(["'])/.exec(state.sliceDoc(string.from, string.to));
  if (quote === null || state.sliceDoc(string.from, string.from + quote[0].length + 2).endsWith('"""')) return null;
  const from = string.from + quote[0].length;
  if (pos < from || !NAME.test(state.sliceDoc(from, pos))) return null;
  const found = (labels: readonly string[], type: string): CompletionResult | null =>
    labels.length === 0 ? null : { from, options: labels.map((label) => ({ label, type })), validFor: NAME };
  if (/parameters(\[|\.get\()\s*$/.test(state.sliceDoc(Math.max(0, string.from - 40), string.from))) {
    return found(parameters, "property");
  }
  const names = callAt(scripting, state, string)?.argument?.names;
  return names === undefined ? null : found(scripting.names[names] ?? [], "constant");
}

interface CallContext {
  parameters: readonly ScriptParameter[];
  /** The argument at the cursor; `undefined` if unknown. */
  argument: ScriptParameter | undefined;
}

/** The sandbox function whose parentheses contain a position. */
function callAt({ api }: Scripting, state: EditorState, node: SyntaxNode): CallContext | null {
  const list = enclosing(node, "ArgList");
  const called = list?.parent?.firstChild;
  if (list === null || called === undefined || called === null) return null;
  const [owner, method] = state.sliceDoc(called.from, called.to).split(".");
  const calls = method === undefined ? api.functions : api.values.find(({ name }) => name === owner)?.methods;
  const call = calls?.find(({ name }) => name === (method ?? owner));
  if (call === undefined) return null;
  const parameters = call.parameters ?? [];
  return { parameters, argument: argumentAt(state, list, parameters, node.from) };
}

function argumentAt(
  state: EditorState,
  list: SyntaxNode,
  parameters: readonly ScriptParameter[],
  at: number,
): ScriptParameter | undefined {
  let count = 0;
  let named: string | null = null;
  for (let child = list.firstChild; child !== null && child.from <= at; child = child.nextSibling) {
    if (child.name === ",") {
      count += 1;
      named = null;
    }
    if (child.name === "VariableName" && child.nextSibling?.name === "AssignOp") {
      named = state.sliceDoc(child.from, child.to);
    }
  }
  if (named !== null) return parameters.find(({ name }) => name === named);
  return parameters.filter(({ kind }) => kind === "positional")[count];
}

function enclosing(node: SyntaxNode, name: string): SyntaxNode | null {
  for (let at: SyntaxNode | null = node; at !== null; at = at.parent) {
    if (at.name === name) return at;
    if (at.name === "Body" || at.name === "Script") return null;
  }
  return null;
}
