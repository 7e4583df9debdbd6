// The robot on its floor, drawn by three.js. Lengths m; z points up.

import * as THREE from "three";
import { OrbitControls } from "./lib/three/OrbitControls.js";

const [PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX] = [0, 2, 3, 4, 5, 6]; // MuJoCo's types of shapes
const SKY = 0xd5dee6;
const LOOKS = 3; // groups below this one are shown, as in MuJoCo's own viewer
const NEWTONS = 100; // a meter of the arrow that shows a push

export class View {
  constructor(canvas, sim) {
    this.sim = sim;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(SKY);
    this.scene.fog = new THREE.Fog(SKY, 8, 25);
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.05, 60);
    this.camera.up.set(0, 0, 1);
    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.maxPolarAngle = 1.55;
    this.orbit.minDistance = 0.7;
    this.orbit.maxDistance = 12;
    this.orbit.enablePan = false;
    this.#light();
    this.shapes = this.#shapes();
    this.arrow = new THREE.ArrowHelper(new THREE.Vector3(1, 0, 0), new THREE.Vector3(), 1, 0xd03030);
    this.scene.add(this.arrow);
    this.size = [0, 0];
    this.showShapes(false);
    this.follow();
  }

  #light() {
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8895a0, 1.6));
    this.sun = new THREE.DirectionalLight(0xffffff, 2);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    Object.assign(this.sun.shadow.camera, { left: -2, right: 2, top: 2, bottom: -2, near: 0.5, far: 12 });
    this.scene.add(this.sun, this.sun.target);
  }

  #shapes() {
    const { model } = this.sim;
    const robot = Array.from({ length: model.ngeom }, (_, i) => i).filter((i) => model.geom_bodyid[i] > 0);
    const bare = !robot.some((i) => model.geom_group[i] < LOOKS); // a robot without looks shows what collides
    const found = [];
    for (let i = 0; i < model.ngeom; i++) {
      const geometry = shape(model.geom_type[i], Array.from(model.geom_size.slice(3 * i, 3 * i + 3)));
      if (!geometry) continue;
      const plane = model.geom_type[i] === PLANE;
      const look = plane ? { map: tiles() } : color(model, i);
      const material = new THREE.MeshStandardMaterial({ roughness: 0.6, metalness: 0.1, ...look });
      const mesh = new THREE.Mesh(geometry, material);
      mesh.castShadow = !plane;
      mesh.receiveShadow = true;
      mesh.matrixAutoUpdate = false;
      this.scene.add(mesh);
      found.push({ mesh, geom: i, looks: plane || bare || model.geom_group[i] < LOOKS, plane });
    }
    return found;
  }

  /** Show what touches and what marks a fall in place of what the eye sees. */
  showShapes(bare) {
    for (const { mesh, geom, looks, plane } of this.shapes) {
      mesh.visible = plane || (bare ? this.sim.model.geom_group[geom] >= LOOKS : looks);
    }
  }

  /** Put the camera at its place beside the robot. */
  follow() {
    const [x, y] = this.sim.place;
    this.orbit.target.set(x, y, 0.65);
    this.camera.position.set(x + 1.9, y - 2.4, 1.4);
    this.orbit.update();
  }

  draw() {
    const { data, place } = this.sim;
    const [places, axes] = [data.geom_xpos, data.geom_xmat];
    for (const { mesh, geom, plane } of this.shapes) {
      const at = places.subarray(3 * geom, 3 * geom + 3);
      const r = axes.subarray(9 * geom, 9 * geom + 9);
      mesh.matrix.set(r[0], r[1], r[2], at[0], r[3], r[4], r[5], at[1], r[6], r[7], r[8], at[2], 0, 0, 0, 1);
      // The drawn floor has an end, and its tiles are 1 m long: it moves with the robot by whole tiles.
      if (plane) mesh.matrix.multiply(new THREE.Matrix4().makeTranslation(Math.round(place[0]), Math.round(place[1]), 0));
      mesh.matrixWorldNeedsUpdate = true;
    }
    const moved = new THREE.Vector3(place[0], place[1], this.orbit.target.z).sub(this.orbit.target);
    this.orbit.target.add(moved);
    this.camera.position.add(moved);
    this.sun.position.set(place[0] + 2, place[1] - 2.5, 5);
    this.sun.target.position.set(place[0], place[1], 0.5);
    this.#point();
    this.#fit();
    this.orbit.update();
    this.renderer.render(this.scene, this.camera);
  }

  #point() {
    const { force, place } = this.sim;
    this.arrow.visible = force !== null;
    if (!force) return;
    const along = new THREE.Vector3(...force);
    const length = along.length() / NEWTONS;
    this.arrow.setDirection(along.normalize());
    this.arrow.setLength(Math.max(length, 0.05), 0.12, 0.08);
    this.arrow.position.set(...place).addScaledVector(along, -length);
  }

  #fit() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    if (width === this.size[0] && height === this.size[1]) return;
    this.size = [width, height];
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
  }
}

/** A shape of MuJoCo, whose axis is z; null for a kind that is not drawn. */
function shape(type, [a, b, c]) {
  if (type === PLANE) return new THREE.PlaneGeometry(40, 40);
  if (type === SPHERE) return new THREE.SphereGeometry(a, 24, 16);
  if (type === ELLIPSOID) return new THREE.SphereGeometry(1, 24, 16).scale(a, b, c);
  if (type === BOX) return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
  if (type === CAPSULE) return new THREE.CapsuleGeometry(a, 2 * b, 8, 20).rotateX(Math.PI / 2);
  if (type === CYLINDER) return new THREE.CylinderGeometry(a, a, 2 * b, 24).rotateX(Math.PI / 2);
  return null;
}

function color(model, geom) {
  const material = model.geom_matid[geom];
  const [values, at] = material < 0 ? [model.geom_rgba, 4 * geom] : [model.mat_rgba, 4 * material];
  const [red, green, blue, alpha] = values.slice(at, at + 4);
  const mixed = new THREE.Color().setRGB(red, green, blue, THREE.SRGBColorSpace);
  return { color: mixed, opacity: alpha, transparent: alpha < 1 };
}

/** A floor of tiles; four make a picture, so that one is 1 m long on a floor of 40 m. */
function tiles() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 256;
  const pen = canvas.getContext("2d");
  [0, 1, 2, 3].forEach((i) => {
    const [x, y] = [i % 2, Math.floor(i / 2)];
    pen.fillStyle = x === y ? "#aab3bb" : "#9aa4ad";
    pen.fillRect(128 * x, 128 * y, 128, 128);
  });
  const texture = new THREE.CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(20, 20);
  texture.anisotropy = 8;
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}
