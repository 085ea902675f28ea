// SPDX-License-Identifier: Apache-2.0
// A map that can be turned and zoomed: the height of a node is its error, enlarged.
// Bundled with three.js into selfcal_ros/reporting/assets/map3d.min.js by `make map3d`.
import {
  BufferAttribute, BufferGeometry, Color, DoubleSide, LineBasicMaterial, LineSegments, Mesh,
  MeshBasicMaterial, PerspectiveCamera, Raycaster, Scene, Vector2, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const QUANTITIES = {
  "|G|": (node) => Math.hypot(node.gx, node.gy),
  Gx: (node) => node.gx,
  Gy: (node) => node.gy,
  U: (node) => node.u,
};
const HEIGHT = 0.35; // of the largest value, in lengths of the longer side

/** Show the map that `box` carries as data-map: x, y in mm; gx, gy, u in µm, null if unknown. */
function show(box) {
  const map = JSON.parse(box.dataset.map);
  const renderer = new WebGLRenderer({ antialias: true, alpha: true });
  const scene = new Scene();
  const camera = new PerspectiveCamera(35, 1, 0.01, 100);
  camera.up.set(0, 0, 1);
  const controls = new OrbitControls(camera, renderer.domElement);
  // whoever scrolls past the map on the way down the page does not zoom it
  controls.enableZoom = false;
  renderer.domElement.style.touchAction = "pan-y";
  const select = document.createElement("select");
  const reset = document.createElement("button");
  const readout = document.createElement("output");
  reset.textContent = "x to the right, y away";
  for (const name of Object.keys(QUANTITIES)) select.add(new Option(name, name));
  select.setAttribute("aria-label", "height");
  const bar = document.createElement("p");
  bar.append("height: ", select, " ", reset, " ", readout);
  box.append(renderer.domElement, bar);
  box.hidden = false;

  const nodes = [];
  map.x.forEach((x, i) => map.y.forEach((y, j) => nodes.push(
    { x, y, gx: map.gx[i][j], gy: map.gy[i][j], u: map.u[i][j] })));
  const side = Math.max(...map.x.map(Math.abs), ...map.y.map(Math.abs));
  const surface = new Mesh(new BufferGeometry(), new MeshBasicMaterial(
    { vertexColors: true, side: DoubleSide, polygonOffset: true, polygonOffsetFactor: 1 }));
  const mesh = new LineSegments(new BufferGeometry(), new LineBasicMaterial(
    { color: 0x404a54, transparent: true, opacity: 0.55 }));
  const floor = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: 0x8a949e }));
  scene.add(surface, mesh, floor);

  const style = getComputedStyle(document.documentElement);
  const ramp = ["--d0", "--paper", "--d10"].map(
    (name) => new Color(style.getPropertyValue(name).trim() || "#ffffff"));
  const colour = (part) => (part < 0 ? ramp[1].clone().lerp(ramp[0], -part)
    : ramp[1].clone().lerp(ramp[2], part));

  function draw() {
    const value = QUANTITIES[select.value];
    const known = nodes.map((node) => node.gx !== null && node.gy !== null);
    const values = nodes.map((node, k) => (known[k] ? value(node) : 0));
    const largest = Math.max(...values.map(Math.abs)) || 1;
    const places = nodes.flatMap((node, k) => [
      node.x / side, node.y / side, HEIGHT * 2 * values[k] / largest]);
    const colours = values.flatMap((each) => colour(each / largest).toArray());
    const [faces, edges] = [[], []];
    const rows = map.y.length;
    nodes.forEach((_, k) => {
      const [i, j] = [Math.floor(k / rows), k % rows];
      const right = i + 1 < map.x.length;
      const up = j + 1 < rows;
      if (right && known[k] && known[k + rows]) edges.push(k, k + rows);
      if (up && known[k] && known[k + 1]) edges.push(k, k + 1);
      if (right && up && [k, k + 1, k + rows, k + rows + 1].every((n) => known[n])) {
        faces.push(k, k + rows, k + rows + 1, k, k + rows + 1, k + 1);
      }
    });
    for (const [part, index] of [[surface, faces], [mesh, edges]]) {
      part.geometry.dispose();
      part.geometry = new BufferGeometry();
      part.geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
      part.geometry.setIndex(index);
    }
    surface.geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 3));
    const [a, b] = [map.x, map.y].map((all) => Math.max(...all.map(Math.abs)) / side);
    const corners = [[-a, -b], [a, -b], [a, b], [-a, b]];
    const outline = corners.flatMap((corner, n) => [...corner, 0, ...corners[(n + 1) % 4], 0]);
    floor.geometry.setAttribute("position", new BufferAttribute(new Float32Array(outline), 3));
    readout.textContent = `largest ${largest.toPrecision(3)} µm; drag to turn, then wheel to zoom`;
    paint();
  }
  function paint() { renderer.render(scene, camera); }
  function fit() {
    const width = box.clientWidth;
    const height = Math.min(520, Math.round(0.75 * width));
    renderer.setPixelRatio(window.devicePixelRatio);
    renderer.setSize(width, height);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    paint();
  }
  function front() {
    camera.position.set(0.9, -3.1, 2.3);
    controls.target.set(0, 0, 0);
    controls.update();
    paint();
  }
  renderer.domElement.addEventListener("pointermove", (event) => {
    const at = renderer.domElement.getBoundingClientRect();
    const ray = new Raycaster();
    ray.setFromCamera(new Vector2(2 * (event.clientX - at.left) / at.width - 1,
      1 - 2 * (event.clientY - at.top) / at.height), camera);
    const [hit] = ray.intersectObject(surface);
    if (!hit) return;
    const near = [hit.face.a, hit.face.b, hit.face.c].map((k) => nodes[k]).reduce((one, other) => (
      Math.hypot(one.x / side - hit.point.x, one.y / side - hit.point.y)
      < Math.hypot(other.x / side - hit.point.x, other.y / side - hit.point.y) ? one : other));
    readout.textContent = `x ${near.x} mm, y ${near.y} mm: Gx ${near.gx} µm, Gy ${near.gy} µm, `
      + `U ${near.u ?? "unknown"} µm`;
  });
  renderer.domElement.addEventListener("pointerdown", () => { controls.enableZoom = true; });
  renderer.domElement.addEventListener("pointerleave", () => { controls.enableZoom = false; });
  controls.addEventListener("change", paint);
  select.addEventListener("change", draw);
  reset.addEventListener("click", front);
  new ResizeObserver(fit).observe(box);
  front();
  draw();
  fit();
}

for (const box of document.querySelectorAll(".map3d")) {
  try { show(box); } catch (error) { box.hidden = true; } // no WebGL: the drawings say the same
}
