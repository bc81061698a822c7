const canvas = document.getElementById("canvas"), pen = canvas.getContext("2d"), points = {}, pictures = {}, views = {}
let asked, camera, joint, drag = null
const view = () => views[camera], statusLine = document.getElementById("status")
function button(parent, name, act) { const b = document.createElement("button"); b.textContent = name; b.onclick = act
  b.dataset.name = name; document.getElementById(parent).append(b) }
function show() {
  canvas.width = canvas.clientWidth; canvas.height = canvas.clientHeight
  const image = pictures[camera], v = view()
  if (image && image.width && !v.scale) { v.scale = Math.min(canvas.width / image.width, canvas.height / image.height)
    v.x = (canvas.width - image.width * v.scale) / 2; v.y = (canvas.height - image.height * v.scale) / 2 }
  if (v.scale) { pen.setTransform(v.scale, 0, 0, v.scale, v.x, v.y); pen.drawImage(image, 0, 0)
    pen.setTransform(1, 0, 0, 1, 0, 0)
    for (const [name, [a, b]] of Object.entries(points[camera])) { const x = v.x + (a + .5) * v.scale, y = v.y + (b + .5) * v.scale
      pen.strokeStyle = pen.fillStyle = name === joint ? "#ffd400" : "#21c45a"; pen.lineWidth = 2
      pen.beginPath(); pen.arc(x, y, 5, 0, 7); pen.moveTo(x - 9, y); pen.lineTo(x + 9, y); pen.moveTo(x, y - 9)
      pen.lineTo(x, y + 9); pen.stroke(); pen.font = "13px system-ui"; pen.fillText(name, x + 8, y - 6) } }
  for (const b of document.querySelectorAll("#cameras button")) { b.classList.toggle("now", b.dataset.name === camera)
    b.classList.toggle("set", asked.joints.every(j => points[b.dataset.name][j])) }
  for (const b of document.querySelectorAll("#joints button")) { b.classList.toggle("now", b.dataset.name === joint)
    b.classList.toggle("set", !!points[camera][b.dataset.name]) }
}
const at = e => [(e.offsetX - view().x) / view().scale - .5, (e.offsetY - view().y) / view().scale - .5]
canvas.onmousedown = e => drag = { x: e.offsetX, y: e.offsetY, moved: false }
canvas.onmousemove = e => { if (!drag || !view().scale) return
  if (Math.hypot(e.offsetX - drag.x, e.offsetY - drag.y) > 4 || drag.moved) { view().x += e.offsetX - drag.x
    view().y += e.offsetY - drag.y; drag = { x: e.offsetX, y: e.offsetY, moved: true }; show() } }
canvas.onmouseup = e => { const still = drag && !drag.moved; drag = null
  if (!still || e.button || !view().scale) return
  points[camera][joint] = at(e).map(v => Math.round(v * 100) / 100)
  joint = asked.joints.find(j => !points[camera][j]) || joint; show() }
canvas.oncontextmenu = e => { e.preventDefault(); delete points[camera][joint]; show() }
canvas.onwheel = e => { e.preventDefault(); const v = view(), f = Math.exp(-e.deltaY / 400)
  v.x = e.offsetX - (e.offsetX - v.x) * f; v.y = e.offsetY - (e.offsetY - v.y) * f; v.scale *= f; show() }
const socket = new WebSocket(location.href.replace(/^http/, "ws"))
document.getElementById("done").onclick = () => socket.send(JSON.stringify({ step: asked.step, points }))
onresize = () => asked && show()
socket.onclose = () => { if (statusLine.className !== "good") statusLine.textContent = "kinefit init has ended; run it again" }
socket.onmessage = event => { const all = JSON.parse(event.data)
  if (!all.cameras) { statusLine.textContent = all.answer; statusLine.className = all.taken ? "good" : ""; return }
  asked = all; camera = all.cameras[0]; joint = all.joints[0]
  for (const name of all.cameras) { points[name] = {}; views[name] = {}; pictures[name] = new Image()
    pictures[name].onload = show; pictures[name].src = "picture/" + encodeURIComponent(name)
    button("cameras", name, () => { camera = name; joint = asked.joints.find(j => !points[name][j]) || joint; show() }) }
  for (const name of all.joints) button("joints", name, () => { joint = name; show() })
  show() }
