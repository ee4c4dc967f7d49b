// SPDX-License-Identifier: Apache-2.0
// Crash TRIGGER: the virtual machine writes its report over the last one.
public class Crash {
    public static void main(String[] args) throws Exception {
        java.io.File trigger = new java.io.File(args[0]);
        java.nio.file.Path crashes = java.nio.file.Path.of(args[0] + ".crashes");
        java.lang.reflect.Field field = sun.misc.Unsafe.class.getDeclaredField("theUnsafe");
        field.setAccessible(true);
        sun.misc.Unsafe unsafe = (sun.misc.Unsafe) field.get(null);

        while (true) {
            Thread.sleep(5);
            if (trigger.exists()) {
                trigger.delete();
                java.nio.file.Files.writeString(crashes, ".", java.nio.file.StandardOpenOption.CREATE,
                    java.nio.file.StandardOpenOption.APPEND);
                unsafe.putByte(8L, (byte) 1);
            }
        }
    }
}
