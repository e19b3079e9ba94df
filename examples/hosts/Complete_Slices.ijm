// Fill a stack of labels between annotated slices by curvafit, which runs outside of Fiji, on the active image.
// Put this file into Fiji's plugins/Scripts folder, or open it and press Run. The lines with #@ ask for values.
#@ File (label = "curvafit program", description = "what `which curvafit` says in a terminal, on Windows `where curvafit`") program
#@ String (label = "known slices", choices = {"those with labels", "every n-th"}) known
#@ Integer (label = "n, of every n-th", value = 8, min = 2) n
#@ Boolean (label = "several labels", value = false) several
#@ String (label = "grey image: a file, or nothing", value = "", required = false) image

name = getTitle();
folder = getDirectory("temp") + "curvafit_" + d2s(getTime(), 0) + File.separator;
File.makeDirectory(folder);
run("Duplicate...", "title=curvafit_labels duplicate");
saveAs("Tiff", folder + "labels.tif");
close();

// exec takes no arrays: an option that is not wanted becomes the axis once more.
knownOption = "--axis"; knownValue = "z";
if (known == "every n-th") { knownOption = "--every"; knownValue = d2s(n, 0); }
labelOption = "--axis"; labelValue = "z";
if (several) { labelOption = "--labels"; labelValue = "all"; }
imageOption = "--axis"; imageValue = "z";
if (lengthOf(image) > 0) { imageOption = "--image"; imageValue = image; }

showStatus("curvafit fills the stack ...");
said = exec(program, "reconstruct", folder + "labels.tif", "-o", folder + "filled.tif", knownOption, knownValue, labelOption, labelValue, imageOption, imageValue);
print(said);
if (!File.exists(folder + "filled.tif"))
    exit("curvafit did not fill the stack. Run in a terminal: curvafit reconstruct " + folder + "labels.tif -o filled.tif");
open(folder + "filled_probability.tif");
rename("probability of " + name);
open(folder + "filled.tif");
rename("filled " + name);
Stack.getStatistics(voxels, mean, least, most);
setMinAndMax(0, most);
