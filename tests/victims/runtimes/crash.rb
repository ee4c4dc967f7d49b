# SPDX-License-Identifier: Apache-2.0
# crash.rb TRIGGER: the interpreter's report takes a tenth of a second.
require "fiddle"

3.times { Thread.new { loop { sleep 0.002 } } }
wild = Fiddle::Pointer.new(8)
loop do
  sleep 0.005
  next unless File.exist?(ARGV[0])

  File.delete(ARGV[0])
  File.write("#{ARGV[0]}.crashes", ".", mode: "a")
  wild[0, 1] = " "
end
