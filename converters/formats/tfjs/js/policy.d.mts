/** Types of policy.mjs. */

/** Numbers for one input: nested arrays, a flat typed array in C order, or data with a shape. */
export type Numbers = number | readonly Numbers[] | Float32Array | Int32Array | Uint8Array | Uint8ClampedArray | Tensor;

export interface Tensor {
  readonly data: Float32Array | Int32Array | Uint8Array | Uint8ClampedArray;
  readonly shape: readonly number[];
}

export interface TensorSpec {
  readonly name: string;
  readonly role: string;
  readonly dtype: "float32" | "int32" | "int64" | "bool";
  /** null: a free axis; the agents come first. */
  readonly shape: readonly (number | null)[];
}

/** policy.json. */
export interface Contract {
  readonly name: string;
  readonly action_space: "continuous" | "discrete" | "hybrid";
  readonly inputs: readonly TensorSpec[];
  readonly outputs: readonly TensorSpec[];
  readonly branches: readonly number[];
  /** Of images: their layout, and the range that bytes are brought to. */
  readonly preprocess?: Readonly<Record<string, { readonly layout: string; readonly range: readonly [number, number] }>>;
  /** Names for people, where the export was given some (`--labels`). */
  readonly labels?: {
    readonly observations?: Readonly<Record<string, readonly string[]>>;
    readonly actions?: readonly string[];
    readonly branches?: readonly (readonly string[])[];
  };
  readonly memory: { size: number; input: string | null; output: string | null; layout: readonly string[] } | null;
}

export interface DecideOptions {
  /** [agents, ΣB]: 1 allows an action, 0 forbids it; all are allowed without it. Each branch needs one. */
  masks?: Numbers;
  /** The memory of the last decision; zero, as at the start of an episode, without it. */
  memory?: Numbers | null;
  /** The discrete actions of the last step, for policies that ask for them. */
  previous?: Numbers | null;
  /** The source's own placeholders. */
  parameters?: Record<string, Numbers>;
  /** The likeliest action and the mean, without chance. */
  deterministic?: boolean;
  /** Start the draws anew before this decision. */
  seed?: number;
}

export interface Decision {
  /** [agent][number], null where the policy has no continuous actions. */
  continuous: number[][] | null;
  /** [agent][branch], null where the policy has no discrete actions. */
  discrete: number[][] | null;
  /** To be passed in at the next step; null where the policy has no memory. */
  memory: Tensor | null;
  /** All outputs by name; one that is the action itself is the action that was taken, not another draw. */
  outputs: Record<string, Tensor>;
}

export type Observations = Numbers | Record<string, Numbers>;

export declare class Generator {
  constructor(seed: number);
  /** In [0, 1). */
  uniform(): number;
  /** N(0, 1). */
  normal(): number;
  /** An index of the log-probabilities. */
  choice(logProbs: ArrayLike<number>): number;
}

export declare class Policy {
  readonly contract: Contract;
  readonly name: string;
  readonly observations: readonly TensorSpec[];
  /** Actions for the agents whose observations are given; an Error says what is missing or of the wrong size. */
  decide(observations: Observations, options?: DecideOptions): Promise<Decision>;
  agent(options?: { deterministic?: boolean }): Agent;
  /** Whether an input has this role ("masks", "memory_in", "prev_action" …). */
  takes(role: string): boolean;
  seed(seed: number): void;
  dispose(): void;
}

export declare class Agent {
  readonly policy: Policy;
  readonly deterministic: boolean;
  /** An episode begins: for all, or for the agents with these numbers. */
  reset(agents?: number | readonly number[]): void;
  decide(
    observations: Observations,
    options?: Pick<DecideOptions, "masks" | "parameters" | "deterministic">,
  ): Promise<Decision>;
}

/** `source`: the URL of model.json or a loader with `load()` (TensorFlow.js); the URL or bytes of the .onnx; for `code`, the
 *  module of --to js, policy.json or its URL. */
export declare function loadPolicy(
  source: string | Uint8Array | ArrayBuffer | Contract | { load(): Promise<unknown> },
  options: { tf?: unknown; ort?: unknown; code?: unknown; contract?: string | Contract; seed?: number },
): Promise<Policy>;
