#!/usr/bin/env bash
# Makes a virtual environment with a real ROS 2, for the tests of headvox_ros where no ROS is installed:
#     ros/test_env.sh FOLDER
# rclpy and the common messages come as wheels; tf2_msgs and vision_msgs, which do not, are generated from
# ros/test_msgs. Needs cmake, make, a C++ compiler and Python's headers. PYTHON chooses the interpreter. A folder that is
# complete is left alone.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
venv=$(realpath -m "${1:?give the folder to make}")

fail() { printf 'test_env.sh: %s\n' "$*" >&2; exit 1; }

for tool in cmake g++ make; do
  command -v "$tool" > /dev/null || fail "needs $tool. On Debian: apt-get install cmake g++ make"
done
headers=$("${PYTHON:-python3}" -c 'import sysconfig; print(sysconfig.get_path("include"))')
[ -f "$headers/Python.h" ] || fail "needs $headers/Python.h. On Debian: apt-get install python3-dev"
[ "$(uname -m)" = x86_64 ] || fail "the ROS wheels are for x86_64 only, this is $(uname -m)"
wanted=$(find "$here/test_env.sh" "$here/test_requirements.txt" "$here/test_msgs" -type f -print0 | sort -z | xargs -0 sha256sum | sha256sum)
[ "$(cat "$venv/complete" 2> /dev/null)" != "$wanted" ] || { echo "$venv is complete"; exit 0; }

"${PYTHON:-python3}" -m venv --clear "$venv"
PATH="$venv/bin:$PATH"
pip install --quiet --disable-pip-version-check -r "$here/test_requirements.txt"

# The CMake files of the wheels name the Python they were built with.
python_include=$(python -c 'import sysconfig; print(sysconfig.get_path("include"))')
numpy_include=$(python -c 'import numpy; print(numpy.get_include())')
site=$(python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
grep -rlE --include='*.cmake' '/opt/python/' "$venv/share" | xargs --no-run-if-empty sed -E -i \
  -e "s#/opt/python/[^;\"]*/numpy/[^;\"]*include#$numpy_include#g" \
  -e "s#/opt/python/[^;\"]*/include/python[0-9.]+#$python_include#g"

export AMENT_PREFIX_PATH="$venv" CMAKE_PREFIX_PATH="$venv" _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
LD_LIBRARY_PATH="$venv/lib:$(printf '%s:' "$site"/ros_*.libs)${LD_LIBRARY_PATH:-}"
export LD_LIBRARY_PATH
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
for package in tf2_msgs vision_msgs; do
  log="$build/$package.log"
  {
    cmake -S "$here/test_msgs/$package" -B "$build/$package" -DCMAKE_INSTALL_PREFIX="$venv" -DBUILD_TESTING=OFF \
      -DPython3_EXECUTABLE="$venv/bin/python" -DPython3_FIND_VIRTUALENV=ONLY &&
      cmake --build "$build/$package" --parallel 2 &&
      cmake --install "$build/$package"
  } > "$log" 2>&1 || { tail -40 "$log" >&2; fail "could not generate $package"; }
done
unset LD_LIBRARY_PATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

python - << 'CHECK' || fail "the environment does not work"
from rclpy.serialization import deserialize_message, serialize_message
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3D, Detection3DArray

sent = Detection3DArray(detections=[Detection3D(id="7")])
assert deserialize_message(serialize_message(sent), Detection3DArray) == sent
assert deserialize_message(serialize_message(TFMessage()), TFMessage) == TFMessage()
CHECK
printf '%s\n' "$wanted" > "$venv/complete"
echo "$venv is complete ($SECONDS s)"
