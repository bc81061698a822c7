"""Recordings of ROS 2 in MCAP, written by rosbags, which shares no code with what reads them."""

import cv2
import numpy as np

START = 5 * 10**9  # [ns] stamp of the first image
LOGGED = 7 * 10**9  # [ns] when it was logged


class Bag:
    """Messages of one recording, written at once.

    Images are 0.1 s apart by their headers and 0.2 s by the log; `step` [ns] and `start` [ns] change the headers.
    """

    def __init__(self):
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.types, self.messages = self.store.types, []

    def header(self, ns, frame="camera"):
        stamp = self.types["builtin_interfaces/msg/Time"](sec=int(ns // 10**9), nanosec=int(ns % 10**9))
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def images(self, topic, encoding, arrays, *, start=START, step=10**8, stamped=True):
        """Images of an encoding; "16UC1>" is big-endian, "16UC1 png", "32FC1 png" and "jpeg" are compressed."""
        for k, array in enumerate(arrays):
            ns = start + k * step if stamped else 0
            self.messages.append((topic, self.image(encoding, array, ns), LOGGED + (start - START) + k * 2 * step))
        return self

    def image(self, encoding, array, ns):
        packed = self.types["sensor_msgs/msg/CompressedImage"]
        if encoding == "jpeg":
            data = cv2.imencode(".jpg", array[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].ravel()
            return packed(header=self.header(ns), format="rgb8; jpeg compressed bgr8", data=data)
        if encoding == "32FC1 png":  # as compressed_depth_image_transport does: counts of a / z + b
            a, b = 100.0 * 101.0, 1.0 - 101.0
            counts = np.where(array > 0, np.rint(a / np.maximum(array, 1e-9) + b), 0)
            head = np.frombuffer(np.int32(0).tobytes() + np.float32(a).tobytes() + np.float32(b).tobytes(), np.uint8)
            data = np.concatenate([head, cv2.imencode(".png", counts.astype(np.uint16))[1].ravel()])
            return packed(header=self.header(ns), format="32FC1; compressedDepth png", data=data)
        if encoding.endswith("png"):
            data = np.concatenate([np.zeros(12, np.uint8), cv2.imencode(".png", array)[1].ravel()])
            return packed(header=self.header(ns), format="16UC1; compressedDepth png", data=data)
        big = encoding.endswith(">")
        raw = np.ascontiguousarray(array.astype(array.dtype.newbyteorder(">" if big else "<")))
        rows = np.pad(raw.view(np.uint8).reshape(len(array), -1), ((0, 0), (0, 4)))  # rows may be longer than the image
        return self.types["sensor_msgs/msg/Image"](
            header=self.header(ns), height=array.shape[0], width=array.shape[1], encoding=encoding.rstrip(">"),
            is_bigendian=int(big), step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip

    def info(self, topic, K, size, *, model="plumb_bob", lens=(), frame="camera", P=None):
        t, P = self.types, np.zeros(12) if P is None else np.ravel(P).astype(float)
        roi = t["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        message = t["sensor_msgs/msg/CameraInfo"](
            header=self.header(0, frame), height=size[1], width=size[0], distortion_model=model,
            d=np.array(lens, float), k=np.ravel(K).astype(float), r=np.eye(3).ravel(), p=P, binning_x=0, binning_y=0,
            roi=roi,
        )  # fmt: skip
        self.messages.append((topic, message, LOGGED))
        return self

    def static(self, *transforms):
        """/tf_static of (parent, child, T_parent_child)."""
        from scipy.spatial.transform import Rotation

        t, out = self.types, []
        for parent, child, T in transforms:
            q = Rotation.from_matrix(T[:3, :3]).as_quat()
            move = t["geometry_msgs/msg/Transform"](
                translation=t["geometry_msgs/msg/Vector3"](*map(float, T[:3, 3])),
                rotation=t["geometry_msgs/msg/Quaternion"](*map(float, q)),
            )
            header = self.header(0, parent)
            out.append(t["geometry_msgs/msg/TransformStamped"](header=header, child_frame_id=child, transform=move))
        self.messages.append(("/tf_static", t["tf2_msgs/msg/TFMessage"](transforms=out), LOGGED))
        return self

    def write(self, folder, plugin="MCAP"):
        """The recording's file in a new folder."""
        from rosbags import rosbag2

        with rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin[plugin]) as out:
            topics = {}
            for topic, message, logged in sorted(self.messages, key=lambda one: one[2]):
                if topic not in topics:
                    topics[topic] = out.add_connection(topic, message.__msgtype__, typestore=self.store)
                out.write(topics[topic], logged, self.store.serialize_cdr(message, message.__msgtype__))
        (file,) = [*folder.glob("*.mcap"), *folder.glob("*.db3")]
        return file
