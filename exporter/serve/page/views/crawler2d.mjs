/** Three crawlers, a track each; the picture goes along with them. */

import { Crawler2D, footOf, hipOf, kneeOf, TIME_STEP } from "../scenes/crawler2d.mjs";
import { between, disc } from "./drawing.mjs";

const AGENTS = 3;
const [ABOVE, BELOW] = [1.1, 0.3]; // m of a track, above and below the ground
const NEAR = 1.3; // m, from which a visitor reaches it
const MARK_EVERY = 5; // m
const PLACES = ["rear", "front", "far rear", "far front"];
const JOINTS = ["hip", "knee"].flatMap((joint) => PLACES.map((place) => `${place} ${joint}`));

const view = {
  name: "Crawler2D",
  story:
    "Four legs with a torque at each hip and knee walk to the right. An episode is 20 seconds; one that falls starts the next. " +
    "Lift a crawler and throw it, or click beside it. The environment is this project's own, not ML-Agents' Crawler.",
  poke: "Push them",
  stepSeconds: TIME_STEP,
  agents: AGENTS,
  ratio: (width) => (width < 560 ? 1.1 : 1.9),
  labels: {
    observations: [
      ...["body height", "body level", "body pitch", "speed ahead", "speed up", "body turn"],
      ...JOINTS,
      ...JOINTS.map((joint) => `${joint}, turn`),
      ...PLACES.map((place) => `${place} foot`),
    ],
    actions: JOINTS,
  },
  create: () => new Crawler2D(AGENTS),
  players: ["model"],
  observed: (observation) => observation,
  actions: ({ model }) => model,
  count: (tally, env) => `${Math.max(...metres(env), 0).toFixed(0)} m, falls ${tally.bad}`,
  status(env, tally) {
    const farthest = Math.max(...metres(env), 0);
    const seconds = Math.max(...env.age) * TIME_STEP;
    const speed = seconds > 0 ? farthest / seconds : 0;
    return `farthest ${farthest.toFixed(1)} m · ${speed.toFixed(1)} m/s · walks of 20 s: ${tally.good}`;
  },
  describe(env, tally, chosen) {
    return (
      `${AGENTS} crawlers with four legs walk to the right. Crawler ${chosen + 1} is ${metres(env)[chosen].toFixed(1)} metres from where it ` +
      `began. ${tally.bad} fell so far.`
    );
  },
  gusts: true,
  at,
  draw,
};

export const viewOf = () => view;

const metres = (env) => Array.from({ length: AGENTS }, (_, i) => env.walked(i));

/** A track's own pixels: `to` from metres, `from` to metres. */
function track({ width, height }, i, camera) {
  const tall = height / AGENTS;
  const scale = tall / (ABOVE + BELOW);
  const ground = tall * i + ABOVE * scale;
  return {
    scale,
    ground,
    half: width / 2 / scale,
    to: (x, y) => [width / 2 + (x - camera) * scale, ground - y * scale],
    from: (px, py) => [camera + (px - width / 2) / scale, (ground - py) / scale],
  };
}

function at(size, after, [x, y], agent) {
  const i = agent ?? Math.min(Math.max(Math.floor((y / size.height) * AGENTS), 0), AGENTS - 1);
  const place = track(size, i, after.camera[i]).from(x, y);
  const away = Math.hypot(place[0] - (after.x[i][0] + after.x[i][1]) / 2, place[1] - (after.y[i][0] + after.y[i][1]) / 2);
  return agent === undefined && away > NEAR ? null : { agent: i, place };
}

function draw(context, size, before, after, share, colours, chosen) {
  for (let i = 0; i < AGENTS; i++) {
    const camera = between(before, after, "camera", i, share);
    const place = track(size, i, camera);
    floor(context, size, place, camera, colours, i === chosen);
    const [xs, ys] = [between(before, after, "x", i, share), between(before, after, "y", i, share)];
    crawler(context, place, xs.map((x, k) => place.to(x, ys[k])), colours);
  }
}

function floor(context, { width }, { scale, ground, half, to }, camera, colours, isChosen) {
  context.fillStyle = colours.edge;
  context.fillRect(0, ground, width, BELOW * scale * 0.75);
  context.strokeStyle = isChosen ? colours.accent : colours.soft;
  context.lineWidth = isChosen ? 2.5 : 1;
  line(context, [0, ground], [width, ground]);
  context.lineWidth = 1;
  context.fillStyle = colours.ink;
  context.font = `${Math.max(0.13 * scale, 10)}px system-ui, sans-serif`;
  for (let x = Math.ceil(camera - half); x <= camera + half; x++) {
    const marked = x % MARK_EVERY === 0;
    context.strokeStyle = marked ? colours.soft : colours.rule;
    line(context, to(x, 0), to(x, marked ? -0.2 : -0.07));
    const [px] = to(x, 0);
    if (marked) context.fillText(`${x} m`, px + 5, ground + 0.18 * scale);
  }
}

function crawler(context, { scale, ground }, points, colours) {
  const [rear, front] = points;
  context.lineCap = context.lineJoin = "round";
  context.fillStyle = colours.shade;
  context.beginPath();
  context.ellipse((rear[0] + front[0]) / 2, ground + 0.04 * scale, 0.75 * scale, 0.05 * scale, 0, 0, 2 * Math.PI);
  context.fill();
  for (const leg of [2, 3]) limb(context, scale, points, leg, colours.side);
  const angle = Math.atan2(front[1] - rear[1], front[0] - rear[0]);
  context.save();
  context.translate((rear[0] + front[0]) / 2, (rear[1] + front[1]) / 2);
  context.rotate(angle);
  const light = context.createLinearGradient(0, -0.16 * scale, 0, 0.14 * scale);
  light.addColorStop(0, colours.glint);
  light.addColorStop(0.55, colours.ball);
  const [eyeX, eyeY] = [0.36 * scale, -0.15 * scale];
  const round = (x, y, radius, colour) => {
    context.fillStyle = colour;
    disc(context, x, y, radius * scale);
    context.fill();
  };
  round(eyeX, eyeY, 0.09, colours.ball);
  context.fillStyle = light;
  context.beginPath();
  context.roundRect(-0.58 * scale, -0.15 * scale, 1.16 * scale, 0.28 * scale, 0.14 * scale);
  context.fill();
  round(eyeX + 0.012 * scale, eyeY - 0.012 * scale, 0.06, "#fff");
  round(eyeX + 0.032 * scale, eyeY - 0.012 * scale, 0.03, "#000");
  context.restore();
  for (const leg of [0, 1]) limb(context, scale, points, leg, colours.accent);
}

function limb(context, scale, points, leg, colour) {
  const [hip, knee, foot] = [points[hipOf(leg)], points[kneeOf(leg)], points[footOf(leg)]];
  context.strokeStyle = context.fillStyle = colour;
  context.lineWidth = 0.085 * scale;
  line(context, hip, knee);
  context.lineWidth = 0.06 * scale;
  line(context, knee, foot);
  disc(context, ...knee, 0.055 * scale);
  context.fill();
  disc(context, foot[0], foot[1] - 0.03 * scale, 0.05 * scale);
  context.fill();
}

function line(context, from, to) {
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
}
