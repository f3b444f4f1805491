// A mesh that can be rotated, drawn by three.js (three.bundle.js; THREE-LICENSE.txt).

import * as three from "./three.bundle.js";

export class MeshView {
  constructor(box) {
    this.box = box;
    this.renderer = new three.WebGLRenderer({ antialias: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setClearColor(0x0e0f14);
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(30, 1, 0.01, 50);
    this.scene.add(new three.AmbientLight(0xffffff, 0.7));
    const lamp = new three.DirectionalLight(0xffffff, 2.4);
    lamp.position.set(-0.5, 0.6, 1);
    this.camera.add(lamp);
    this.scene.add(this.camera);
    const canvas = this.renderer.domElement;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The surface in three dimensions; drag or use the arrow keys to turn it");
    box.replaceChildren(canvas);
    this.controls = new three.OrbitControls(this.camera, canvas);
    this.controls.enablePan = false;
    this.controls.addEventListener("change", () => this.draw());
    canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.15], ArrowDown: [0, 0.15] };
      if (turns[event.key]) { event.preventDefault(); this.turn(...turns[event.key]); }
    });
    new ResizeObserver(() => this.resize()).observe(box);
  }

  async load(address) {
    const geometry = await new three.PLYLoader().loadAsync(address);
    const coloured = geometry.hasAttribute("color");
    const material = new three.MeshStandardMaterial({ vertexColors: coloured, color: coloured ? 0xffffff : 0xb9bed0, roughness: 0.75, side: three.DoubleSide });
    if (this.mesh) { this.scene.remove(this.mesh); this.mesh.geometry.dispose(); this.mesh.material.dispose(); }
    this.mesh = new three.Mesh(geometry, material);
    this.scene.add(this.mesh);
    geometry.computeBoundingSphere();
    const { center, radius } = geometry.boundingSphere;
    this.controls.target.copy(center);
    this.camera.position.set(center.x + 0.9 * radius, center.y + 0.5 * radius, center.z + 3.6 * radius);
    this.controls.update();
    this.resize();
  }

  turn(around, over) {
    const offset = this.camera.position.clone().sub(this.controls.target), distance = offset.length();
    const angle = Math.atan2(offset.x, offset.z) + around;
    const height = Math.min(1.4, Math.max(-1.4, Math.asin(offset.y / distance) - over));
    this.camera.position.set(Math.sin(angle) * Math.cos(height), Math.sin(height), Math.cos(angle) * Math.cos(height)).multiplyScalar(distance).add(this.controls.target);
    this.controls.update();
    this.draw();
  }

  resize() {
    const side = this.box.clientWidth;
    if (!side) return;
    this.renderer.setSize(side, this.box.clientHeight || side, false);
    this.camera.aspect = side / (this.box.clientHeight || side);
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  draw() { this.renderer.render(this.scene, this.camera); }
}
