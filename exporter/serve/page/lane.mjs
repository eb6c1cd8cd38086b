/** One run of an environment, with the policies that act in it. */

import { Player } from "./player.mjs";

export class Lane {
  before = null;
  decision = null;

  /** @param {Record<string, () => object>} policies by the names of the view's players */
  constructor(view, policies) {
    this.view = view;
    this.env = view.create();
    this.players = Object.fromEntries(view.players.map((name) => [name, new Player(policies[name])]));
    this.begin(0);
  }

  begin(seed) {
    this.observation = this.env.reset(seed);
    this.forget();
    this.tally = { good: 0, bad: 0, best: 0, missed: [0, 0], steps: 0 };
    [this.before, this.after, this.decision] = [null, this.env.snapshot(), null];
  }

  forget() {
    Object.values(this.players).forEach((player) => player.forget());
  }

  /** What a visitor did to the environment. */
  change(what) {
    what(this.env);
    this.observation = this.env.observe(this.env.isFirst);
    this.after = this.env.snapshot();
  }

  seen(name = "model") {
    return this.view.observed(this.observation, name);
  }

  async step() {
    const decisions = {};
    for (const [name, player] of Object.entries(this.players)) decisions[name] = await player.act(this.seen(name), this.env.isFirst);
    this.decision = { ...decisions.model, seen: this.seen() };
    this.before = this.after;
    const { observation, rewards, terminated, truncated, success } = this.env.step(this.view.actions(decisions, this.observation));
    this.observation = observation;
    this.after = this.env.snapshot();
    const tally = this.tally;
    tally.steps += 1;
    terminated.forEach((ended, i) => {
      if (ended || truncated[i]) tally[success[i] ? "good" : "bad"] += 1;
      if (Array.isArray(rewards[i])) rewards[i].forEach((reward, side) => (tally.missed[side] += Number(reward < 0)));
    });
    if (this.after.rally) tally.best = Math.max(tally.best, ...this.after.rally);
  }
}

/** How far two lanes are apart: [what the policies answer, where their environments are], as largest differences. */
export function apart(a, b) {
  const answers = ({ decision }) => Object.values(decision?.outputs ?? {}).map(({ data }) => Array.from(data, Number));
  const state = ({ after: { age, ...rest } }) => rest;
  return [largest(answers(a), answers(b)), largest(state(a), state(b))];
}

function largest(a, b) {
  if (typeof a === "number" && typeof b === "number") return a === b || (Number.isNaN(a) && Number.isNaN(b)) ? 0 : Math.abs(a - b);
  if (typeof a !== "object" || typeof b !== "object" || a === null || b === null) return 0;
  return Object.keys(a).reduce((most, key) => Math.max(most, key in b ? largest(a[key], b[key]) : 0), 0);
}
